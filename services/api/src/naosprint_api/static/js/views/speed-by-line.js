/** How the speed depends on where it is measured from, as a figure and as numbers: the paper's measure and that over all episodes. */

import { SPEED_REFS } from "../curves.js";
import { h, scroller } from "../dom.js";
import { profile } from "../evaluation.js";
import { speedByLine } from "../figures.js";
import { fixed, integer, interval } from "../format.js";

/**
 * Two cards about the speed by start line.
 *
 * @param {object} f summary of an evaluation
 * @param {string} level of its intervals, as text
 * @param {(draw: (width: number) => SVGElement) => HTMLElement} figure makes an element of a drawing
 */
export function speedByStartLine(f, level, figure) {
  const { series, table } = lines(f);
  return h("div", { class: "charts four" },
    h("section", { class: "card" }, h("div", { class: "card-head" }, h("h2", null, "Speed by start line"), h("div", { class: "legend" }, series.map((x) => h("span", null, h("i", { style: { background: `var(${x.token})` } }), x.label)))), h("div", { class: "pad" }, figure((w) => speedByLine(w, series, SPEED_REFS)))),
    h("section", { class: "card" }, h("div", { class: "card-head" }, h("h2", null, "The numbers"), h("span", { class: "muted" }, `mean, ${level} interval`)), scroller("Speed by start line", table)));
}

/** Series and table of the speed by start line. */
function lines(f) {
  const series = [{ token: "--s1", label: "as the paper: 200 samples or more", rows: profile(f, "paper") }, { token: "--s2", label: "all episodes", rows: profile(f, "all"), dash: "5 4" }].filter((x) => x.rows.length);
  const cell = (x) => [h("td", { class: "num" }, fixed(x.mean, 3)), h("td", { class: "num muted" }, x.ci ? interval(x.ci, 3) : "–"), h("td", { class: "num muted" }, integer(x.episodes))];
  const th = (t) => h("th", { scope: "col", class: "num" }, t);
  const table = h("table", { class: "plain" }, h("thead", null, h("tr", null, h("th", { rowspan: 2, scope: "col" }, "Line"), h("th", { colspan: 3, scope: "colgroup", class: "group" }, "As the paper, m/s"), h("th", { colspan: 3, scope: "colgroup", class: "group" }, "All episodes, m/s")), h("tr", null, th("mean"), th("interval"), th("n"), th("mean"), th("interval"), th("n"))),
    h("tbody", null, f.speed_by_line.map((e) => h("tr", null, h("td", { class: "nowrap" }, `${fixed(e.line_m, 1)} m`), cell(e.paper), cell(e.all)))));
  return { series, table };
}
