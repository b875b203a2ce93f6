/** One bundled policy: its replay, results, training, and how to use it. */

import { call } from "../api.js";
import { Chart } from "../charts.js";
import { chartOptions } from "../curves.js";
import { descriptions } from "../descriptions.js";
import { fill, h, heading, icon, scroller, table, toast } from "../dom.js";
import { Figure } from "../figures.js";
import { duration, integer } from "../format.js";
import { loading, problem } from "./messages.js";
import { Player } from "./player.js";
import { headlineBlock, tags } from "./policies.js";
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

/** Commands that take the policy by its name, each with what it does. */
const commands = (name) => [
  [`naoctl policies evaluate ${name}`, "Evaluate it again on this machine."],
  [`naoctl policies replay ${name}`, "Run one episode, and film it."],
  [`naoctl policies export ${name}`, "Write it as ONNX, NumPy and JSON."],
  [
    `python -m naosprint train FOLDER --initial-policy ${name}`,
    "Continue training from its weights, without the service.",
  ],
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

/** Charts of the trainings behind a policy, one after the other over all their steps. */
function curves(card, known) {
  const x = [];
  const rows = card.lineage.flatMap(({ curve }) => curve);
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
export async function mount(root, { id, signal }) {
  document.title = `${id} · Policies · naosprint`;
  const parts = [];
  const keep = (part) => {
    parts.push(part);
    return part;
  };
  const section = (title, ...kids) =>
    h("section", { class: "card" }, h("div", { class: "card-head" }, h("h2", null, title)), kids);
  const draw = async () => {
    fill(root, h("div", { class: "card" }, loading("Loading the policy")));
    let card;
    let known;
    try {
      [card, known] = await Promise.all([call(`policies/${encodeURIComponent(id)}`, { signal }), descriptions()]);
    } catch (error) {
      if (error.name !== "AbortError") fill(root, problem(error, draw));
      return;
    }
    const { evaluation, spec } = card;
    const level = levelOf(evaluation);
    const stage = h("section", { class: "card", "aria-label": "Replay" });
    const training = h("div", { class: "pad spec-columns" });
    const evaluated = h("div", { class: "pad spec-columns" });
    const list = (form) => {
      fill(
        training,
        specList(
          spec,
          form?.training(spec),
          form ? overrides(spec, form.presets, form.families.get(spec.robot?.name)) : undefined,
        ),
      );
      fill(evaluated, specList(evaluation, form?.evaluation));
    };
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
          h("h1", null, card.name),
        ),
        h("div", { class: "row wrap" }, tags(card)),
      ),
      h(
        "div",
        { class: "stack" },
        headlineBlock(card),
        stage,
        section("How to use it", usage(card.name)),
        section(`Results of ${integer(card.episodes)} episodes`, scroller("Results", resultsTable(card, level))),
        tableCards(card, level, (drawing) => keep(new Figure(drawing)).element),
        section("Lineage", scroller("Lineage", lineage(card))),
        h(
          "div",
          { class: "charts three" },
          charts.map((chart) => chart.element),
        ),
        section("Training", training),
        section("Evaluation", evaluated),
      ),
    );
    list(null);
    keep(new Player(stage, { path: `policies/${encodeURIComponent(id)}/replay`, task: card.task, signal }));
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
