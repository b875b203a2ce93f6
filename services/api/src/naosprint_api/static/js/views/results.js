/**
 * Results of an evaluation, drawn from the descriptions that they contain: headline, table, and results over a quantity
 * as a figure and numbers.
 */

import { h, heading, scroller, table } from "../dom.js";
import { hasResults, headline, profile } from "../evaluation.js";
import { resultLines } from "../figures.js";
import { integer, intervalText, metricText, percent, shownUnit, withUnit } from "../format.js";

const NONE = "–";
const TOKENS = ["--s1", "--s2", "--s3", "--s4"];

/** Note below a result: its interval, else its standard deviation. */
const note = (r) =>
  r.value === null
    ? "no episode counts"
    : r.interval
      ? intervalText(r, r.interval)
      : r.sd !== null && r.sd !== undefined
        ? `sd ${withUnit(r, r.sd)}`
        : null;

/** One number with its label, unit and note. */
export const stat = (label, value, unit, below, title) =>
  h(
    "div",
    { title: title ?? null },
    h("div", { class: "k" }, label),
    h("div", { class: "v" }, value, value !== NONE && unit ? h("span", { class: "unit" }, unit) : null),
    h("div", { class: "d" }, below ?? "\u00a0"),
  );

/** A result as such a number. */
const resultStat = (r) => stat(r.title, metricText(r, r.value), shownUnit(r), note(r), r.description);

/** The headline of an evaluation or of a policy's card. */
export const headlineStats = (summary) => headline(summary).map(resultStat);

/** Results as a table; `level` names the intervals. */
export function resultsTable(results, level) {
  const head = ["Result", "Value", `${level} interval`, "sd", "Least", "Most", "Episodes"];
  const text = (r, v) => (v === null || v === undefined ? NONE : metricText(r, v));
  return table(
    head.map((title, i) => heading(title, i > 0)),
    results.map((r) =>
      h(
        "tr",
        { title: r.description },
        h(
          "th",
          { scope: "row" },
          r.title,
          r.value === 0 && r.description ? h("div", { class: "muted" }, r.description) : null,
        ),
        h("td", { class: "num" }, withUnit(r, r.value)),
        [intervalText(r, r.interval) ?? NONE, text(r, r.sd), text(r, r.low), text(r, r.high), integer(r.episodes)].map(
          (t) => h("td", { class: "num muted" }, t),
        ),
      ),
    ),
    { class: "plain", "data-part": "results" },
  );
}

/**
 * Two cards about each table of results: a figure, and the numbers.
 *
 * @param {object} summary
 * @param {string} level of its intervals, as text
 * @param {(draw: (width: number) => SVGElement) => HTMLElement} figure makes an element of a drawing
 */
export function tableCards(summary, level, figure) {
  return (summary.tables ?? []).map((table) => {
    const series = table.columns
      .map((column, i) => ({
        token: TOKENS[i % TOKENS.length],
        label: column.title,
        rows: profile(table, column.title),
        dash: i ? "5 4" : undefined,
      }))
      .filter((x) => x.rows.length);
    const axis = axisOf(table);
    return h(
      "div",
      { class: "charts four", "data-table": table.name },
      h(
        "section",
        { class: "card" },
        h(
          "div",
          { class: "card-head" },
          h("h2", null, table.title),
          h(
            "div",
            { class: "legend" },
            series.map((x) => h("span", null, h("i", { style: { background: `var(${x.token})` } }), x.label)),
          ),
        ),
        h(
          "div",
          { class: "pad" },
          h("p", { class: "muted" }, table.description),
          series.length
            ? figure((width) => resultLines(width, series, axis))
            : h("p", { class: "muted" }, "No episode counts."),
        ),
      ),
      h(
        "section",
        { class: "card" },
        h(
          "div",
          { class: "card-head" },
          h("h2", null, "The numbers"),
          h("span", { class: "muted" }, `mean, ${level} interval`),
        ),
        scroller(table.title, numbers(table)),
      ),
    );
  });
}

/** Labels and formats of a table's axes. */
export function axisOf(table, refs = []) {
  const first = table.columns[0]?.results[0];
  const label = (m) => [m.title, shownUnit(m)].filter(Boolean).join(", ");
  return {
    refs,
    metric: first,
    xLabel: label(table.axis),
    yLabel: first ? label(first) : "",
    xFormat: (v) => metricText(table.axis, v),
    format: (v) => (first ? metricText(first, v) : String(v)),
  };
}

function numbers(table) {
  const cells = (r) => [
    h("td", { class: "num" }, metricText(r, r.value)),
    h("td", { class: "num muted" }, intervalText(r, r.interval) ?? NONE),
    h("td", { class: "num muted" }, integer(r.episodes)),
  ];
  const unit = (column) => {
    const u = column.results[0] ? shownUnit(column.results[0]) : "";
    return u ? `${column.title}, ${u}` : column.title;
  };
  return h(
    "table",
    { class: "plain" },
    h(
      "thead",
      null,
      h(
        "tr",
        null,
        h("th", { rowspan: 2, scope: "col" }, table.axis.title),
        table.columns.map((c) => h("th", { colspan: 3, scope: "colgroup", class: "group" }, unit(c))),
      ),
      h(
        "tr",
        null,
        table.columns.map(() => [heading("mean", true), heading("interval", true), heading("n", true)]),
      ),
    ),
    h(
      "tbody",
      null,
      table.at.map((at, i) =>
        h(
          "tr",
          null,
          h("td", { class: "nowrap" }, withUnit(table.axis, at)),
          table.columns.map((c) => cells(c.results[i])),
        ),
      ),
    ),
  );
}

/** The level of an evaluation's intervals as text. */
export const levelOf = (spec) => percent(spec?.confidence ?? 0.95, 0);

export { hasResults };
