/** One policy: its replay, results, versions, training, and how to use it. */

import { call, every, may, query } from "../api.js";
import { Chart } from "../charts.js";
import { chartOptions } from "../curves.js";
import { descriptions } from "../descriptions.js";
import { fill, h, heading, icon, scroller, table, toast } from "../dom.js";
import { headline } from "../evaluation.js";
import { Figure } from "../figures.js";
import { ago, duration, integer, stamp, withUnit } from "../format.js";
import { chooseAlias } from "./job-edit.js";
import { loading, problem } from "./messages.js";
import { Player } from "./player.js";
import { headlineBlock, pageOf, tags } from "./policies.js";
import { levelOf, resultsTable, tableCards } from "./results.js";
import { knowledge, overrides, show, specList } from "./spec-list.js";

function lineage(card) {
  const head = ["Job", "Task", "Preset", "Seed", "Steps", "Took", "Overrides"];
  return table(
    head.map((title, i) => heading(title, i > 2 && i < 6)),
    card.lineage.map((one) =>
      h(
        "tr",
        null,
        h("td", { class: "nowrap" }, one.job),
        h("td", null, one.task),
        h("td", null, one.preset),
        h("td", { class: "num" }, one.seed),
        h("td", { class: "num" }, integer(one.steps)),
        h("td", { class: "num" }, duration(one.training_s)),
        h(
          "td",
          null,
          h(
            "div",
            { class: "row wrap" },
            Object.keys(one.overrides).length
              ? Object.entries(one.overrides).map(([key, value]) =>
                  h("span", { class: "tag" }, `${key} ${show(value)}`),
                )
              : h("span", { class: "muted" }, "none"),
          ),
        ),
      ),
    ),
    { class: "plain", "data-part": "lineage" },
  );
}

/** What a policy stands: its first results under each disturbance, and the ranges in which few enough episodes fail. */
function robustness({ robustness: rows, ranges }) {
  const line = (first, texts) =>
    h(
      "tr",
      null,
      h("th", { scope: "row" }, first),
      texts.map((text) => h("td", { class: "num" }, text)),
    );
  const sections = [];
  if (rows.length) {
    // A card may lack what no episode supported.
    const measured = new Map(rows.flatMap((row) => row.results.map((result) => [result.name, result])));
    const head = ["Disturbance", ...[...measured.values()].map((result) => result.title)].map((title, i) =>
      heading(title, i > 0),
    );
    const body = rows.map((row) => {
      const values = new Map(row.results.map((result) => [result.name, result.value]));
      return line(
        row.disturbance,
        [...measured.values()].map((result) => withUnit(result, values.get(result.name) ?? null)),
      );
    });
    sections.push(["Results under disturbances", table(head, body, { class: "plain", "data-part": "robustness" })]);
  }
  if (ranges?.disturbances.length) {
    const title = `Ranges in which at most ${100 * ranges.most_failures} % of ${ranges.episodes} episodes fail`;
    const head = ["Disturbance", "Range"].map((text, i) => heading(text, i > 0));
    const body = ranges.disturbances.map((each) =>
      line(`${each.disturbance}: ${each.title.toLowerCase()}`, [each.text]),
    );
    sections.push([title, table(head, body, { class: "plain", "data-part": "ranges" })]);
  }
  return sections;
}

/** Commands that take the policy by its name, each with what it does. */
const commands = (name) => [
  [`naoctl download ${name}`, "Download its checkpoint; every SHA-256 is checked."],
  [`naoctl policies evaluate ${name}`, "Evaluate it again on this machine."],
  [`naoctl policies replay ${name}`, "Run one episode, and film it."],
  [`naoctl policies export ${name}`, "Write it as ONNX, NumPy and JSON, as a C header, and as a skill for team code."],
  [`naoctl submit --from-policy ${name}`, "Train from its weights."],
];

function usage(name) {
  const copy = (command) =>
    navigator.clipboard.writeText(command).then(
      () => toast("Copied."),
      () => toast("The browser does not allow copying.", "error"),
    );
  return h(
    "ul",
    { class: "list" },
    commands(name).map(([command, text]) =>
      h(
        "li",
        null,
        h("div", { class: "grow" }, h("code", null, command), h("div", { class: "muted" }, text)),
        h(
          "button",
          { class: "ghost square", "aria-label": `Copy ${command}`, title: "Copy", onclick: () => copy(command) },
          icon("copy"),
        ),
      ),
    ),
  );
}

/** The versions of a policy with their results; `promote` points an alias at one of them. */
function versionsTable(cards, current, promote) {
  const titles = new Map(cards.flatMap((card) => headline(card).map((r) => [r.name, r.title])));
  const row = (card) => {
    const results = new Map(headline(card).map((r) => [r.name, r]));
    return h(
      "tr",
      { "data-version": card.version },
      h(
        "td",
        { class: "nowrap" },
        card.version === current.version
          ? h("b", null, card.reference)
          : h("a", { href: pageOf(card) }, card.reference),
      ),
      h(
        "td",
        null,
        h(
          "div",
          { class: "row wrap" },
          card.aliases.map((alias) => h("span", { class: "tag" }, alias)),
        ),
      ),
      [...titles.keys()].map((name) =>
        h("td", { class: "num" }, results.has(name) ? withUnit(results.get(name), results.get(name).value) : "–"),
      ),
      h("td", { class: "num", title: stamp(card.created_at) }, ago(card.created_at)),
      h(
        "td",
        null,
        may("submit")
          ? h(
              "button",
              { class: "small", "aria-label": `Promote ${card.reference}`, onclick: () => promote(card) },
              "Promote",
            )
          : null,
      ),
    );
  };
  return h(
    "table",
    { class: "plain", "data-part": "versions" },
    h(
      "thead",
      null,
      h(
        "tr",
        null,
        ["Version", "Aliases"].map((text) => h("th", { scope: "col" }, text)),
        [...titles.values(), "Registered"].map((text) => h("th", { scope: "col", class: "num" }, text)),
        h("th", { scope: "col" }, h("span", { class: "sr" }, "Actions")),
      ),
    ),
    h("tbody", null, cards.map(row)),
  );
}

/** Charts of the trainings behind a policy, one after the other over all their steps. */
function curves(card, known) {
  const x = [];
  const rows = card.lineage.map(({ curve }) => curve);
  let before = 0;
  for (const { curve, steps } of card.lineage) {
    for (const step of curve.step) x.push(before + step);
    before += steps;
  }
  const shown = known.charts(card.spec, Object.keys(rows[0] ?? {})).filter((c) => rows.every((row) => row[c.key]));
  return shown.map((c, i) => {
    const options = chartOptions({ ...c, metrics: c.metrics.slice(0, 1) }, i);
    const chart = new Chart({
      ...options,
      sync: `policy-${card.name}`,
      series: [{ label: options.title, token: options.token }],
    });
    chart.setData([x, rows.flatMap((row) => row[c.key])]);
    return chart;
  });
}

/** Show the page in `root`. */
export async function mount(root, { id, params, signal }) {
  document.title = `${id} · Policies · naosprint`;
  const parts = [];
  const keep = (part) => {
    parts.push(part);
    return part;
  };
  const section = (title, ...kids) =>
    h("section", { class: "card" }, h("div", { class: "card-head" }, h("h2", null, title)), kids);
  fill(root, h("div", { class: "card" }, loading("Loading the policy")));
  const draw = async () => {
    let card;
    let known;
    let versions;
    const path = `policies/${encodeURIComponent(id)}`;
    const whose = { owner: params?.get("owner") };
    const owner = query(whose);
    try {
      [card, versions, known] = await Promise.all([
        call(`${path}${owner}`, { signal }),
        every(`${path}/versions`, { params: whose, signal }),
        descriptions(),
      ]);
    } catch (error) {
      if (error.name !== "AbortError") fill(root, problem(error, draw));
      return;
    }
    const promote = async ({ version, reference }) => {
      // Two names are usual; others are set by `naoctl policies promote`.
      const alias = await chooseAlias(reference);
      if (!alias) return;
      try {
        const target = `policies/${card.name}/aliases/${encodeURIComponent(alias)}${owner}`;
        await call(target, { method: "PUT", body: { version } });
        toast(`${card.name}@${alias} is ${reference} now.`);
        await draw();
      } catch (error) {
        toast(error.message, "error");
      }
    };
    const { evaluation, spec } = card;
    const level = levelOf(evaluation);
    const stage = h("section", { class: "card", "aria-label": "Replay" });
    const training = h("div", { class: "pad spec-columns" });
    const evaluated = h("div", { class: "pad spec-columns" });
    const list = (form) => {
      const fields = form?.training(spec);
      fill(
        training,
        specList(
          spec,
          fields,
          form ? overrides(spec, form.presets, form.families.get(spec.robot?.name), fields) : undefined,
        ),
      );
      if (evaluation) fill(evaluated, specList(evaluation, form?.evaluation));
    };
    for (const part of parts.splice(0)) part.destroy();
    const charts = curves(card, known).map(keep);
    fill(
      root,
      h(
        "div",
        { class: "page-head" },
        h(
          "div",
          { class: "grow" },
          h("div", { class: "crumbs" }, h("a", { href: "#/policies" }, "Policies")),
          h("h1", null, card.reference),
          card.notes ? h("p", { class: "soft" }, card.notes) : null,
        ),
        h("div", { class: "row wrap" }, tags(card)),
      ),
      h(
        "div",
        { class: "stack" },
        headlineBlock(card),
        stage,
        section("How to use it", usage(card.reference)),
        card.owner && section("Versions", scroller("Versions", versionsTable(versions, card, promote))),
        evaluation
          ? section(
              `Results of ${integer(card.episodes)} episodes`,
              scroller("Results", resultsTable(known.results(card), level)),
            )
          : section("Results", h("p", { class: "pad" }, "Not evaluated yet: ", h("code", null, `naoctl eval ${id}`))),
        tableCards(card, level, (drawing) => keep(new Figure(drawing)).element),
        robustness(card).map(([title, rows]) => section(title, scroller(title, rows))),
        section("Lineage", scroller("Lineage", lineage(card))),
        h(
          "div",
          { class: "charts three" },
          charts.map((chart) => chart.element),
        ),
        section("Training", training),
        evaluation && section("Evaluation", evaluated),
      ),
    );
    list(null);
    if (evaluation) keep(new Player(stage, { path: `${path}/replay${owner}`, task: card.task, signal }));
    else stage.remove();
    knowledge(signal).then(list, () => {
      /* names and marks are an extra */
    });
  };
  await draw();
  return {
    destroy: () => {
      for (const part of parts) part.destroy();
    },
  };
}
