/** One policy of the box: it runs, its figures, its training and how to use it. */

import { call } from "../api.js";
import { Chart } from "../charts.js";
import { CURVES, refsOf } from "../curves.js";
import { fill, h, icon, scroller, toast } from "../dom.js";
import { Figure } from "../figures.js";
import { duration, fixed, integer, interval, percent, shares } from "../format.js";
import { loading, problem } from "./messages.js";
import { Player } from "./player.js";
import { figuresBlock, tags } from "./policies.js";
import { departures, knowledge, show, specList } from "./spec-list.js";
import { speedByStartLine } from "./speed-by-line.js";

const NONE = "–";

/** Rows of the table of figures in two groups: name, mean or value, interval, standard deviation, least, most, episodes. */
function groups({ figures: f, both_feet_off_ground: airborne, evaluation }) {
  const { paper, run_challenge: challenge } = f;
  const spread = (name, x, unit, digits = 2, title = null) => [name, x.mean === null ? NONE : `${fixed(x.mean, digits)}${unit}`, interval(x.ci, digits), fixed(x.sd, digits), fixed(x.min, digits), fixed(x.max, digits), x.episodes, title];
  const part = (name, x, title = null) => [name, x.mean === null ? NONE : percent(x.mean), shares(x.ci), percent(x.sd), percent(x.min), percent(x.max), x.episodes, title];
  const share = (name, x, title = null) => [name, percent(x.rate), shares(x.ci), NONE, NONE, NONE, f.episodes, title ?? `${integer(x.count)} of ${integer(f.episodes)} episodes`];
  const best = f.speed_by_line.find((e) => e.paper.mean !== null && e.paper.mean === paper.top_speed_mps);
  return [
    ["As the paper measures", [
      ["Top speed", paper.top_speed_mps === null ? NONE : `${fixed(paper.top_speed_mps, 3)} m/s`, interval(best?.paper.ci, 3), fixed(paper.top_speed_sd_mps, 3), fixed(best?.paper.min, 3), fixed(best?.paper.max, 3), best?.paper.episodes, "Best start line, over episodes with 200 samples beyond it"],
      ["Fastest episode", paper.fastest_episode_mps === null ? NONE : `${fixed(paper.fastest_episode_mps, 3)} m/s`, null, NONE, NONE, NONE, null, "Fastest of all episodes from any start line on"],
      ["Deviation", `${fixed(paper.deviation_deg.mean)}°`, null, `${fixed(paper.deviation_deg.sd)}°`, NONE, NONE, f.episodes, "Angle between the running direction and the line from start to end"],
      share("Torso low at the end", paper.low_at_end, "Below the height at which the paper counts a fall"),
    ]],
    ["Unconditional, over all episodes", [
      spread("Mean speed from the start", f.speed_mps, " m/s", 3, `Distance over time from the first step on, task ${evaluation.task}`),
      spread("Distance", f.distance_m, " m"),
      share("Falls", f.falls),
      part("Both feet off the ground", airborne, "Share of time"),
    ]],
    ["The league's run challenge", [
      spread("Score", challenge.score, "", 3, "Speed plus share of time with both feet off the ground"),
      spread("Speed", challenge.speed_mps, " m/s", 3),
      part("Both feet off the ground", challenge.off_ground, "Share of time"),
      share("Falls by its rules", challenge.falls),
    ]],
  ];
}

function figuresTable(card) {
  const head = ["Figure", "Value", `${Math.round(card.evaluation.confidence * 100)} % interval`, "sd", "Least", "Most", "n"];
  return h("table", { class: "plain", "data-part": "figures" },
    h("thead", null, h("tr", null, head.map((text, i) => h("th", { scope: "col", class: i ? "num" : null }, text)))),
    groups(card).map(([title, rows]) => h("tbody", null, h("tr", null, h("th", { class: "group-row", scope: "rowgroup", colspan: head.length }, title)),
      rows.map(([name, value, ci, sd, least, most, n, hint]) => h("tr", { title: hint }, h("th", { scope: "row" }, name), h("td", { class: "num" }, value), [ci ?? NONE, sd, least, most, integer(n)].map((text) => h("td", { class: "num muted" }, text)))))));
}

function lineage(card) {
  const head = ["Job", "Task", "Preset", "Seed", "Steps", "Took", "Departs from the preset by"];
  return h("table", { class: "plain", "data-part": "lineage" }, h("thead", null, h("tr", null, head.map((text, i) => h("th", { scope: "col", class: i > 2 && i < 6 ? "num" : null }, text)))),
    h("tbody", null, card.lineage.map((one) => h("tr", null, h("td", { class: "nowrap" }, one.job), h("td", null, one.task), h("td", null, one.preset), h("td", { class: "num" }, one.seed), h("td", { class: "num" }, integer(one.steps)), h("td", { class: "num" }, duration(one.training_s)),
      h("td", null, h("div", { class: "row wrap" }, Object.keys(one.departures).length ? Object.entries(one.departures).map(([key, value]) => h("span", { class: "tag" }, `${key} ${show(value)}`)) : h("span", { class: "muted" }, "nothing")))))));
}

/** Commands that take the policy by its name, each with what it does. */
const commands = (name) => [
  [`naoctl policies evaluate ${name}`, "Judge it anew on this machine."],
  [`naoctl policies replay ${name}`, "Let it run once, and film it."],
  [`naoctl policies export ${name}`, "Write it as ONNX, NumPy and JSON."],
  [`python -m naosprint train FOLDER --initial-policy ${name}`, "Train on from its weights, without the service."],
];

function usage(name) {
  const copy = (command) => navigator.clipboard.writeText(command).then(() => toast("Copied."), () => toast("The browser refused the clipboard.", "error"));
  return h("ul", { class: "list" }, commands(name).map(([command, text]) => h("li", null, h("div", { class: "grow" }, h("code", null, command), h("div", { class: "muted" }, text)),
    h("button", { class: "ghost square", "aria-label": `Copy ${command}`, title: "Copy", onclick: () => copy(command) }, icon("copy")))));
}

/** Charts of the trainings behind a policy, one after the other over all their steps. */
function curves(card) {
  const x = [], rows = card.lineage.flatMap(({ curve }) => curve);
  let before = 0;
  for (const { curve, steps } of card.lineage) {
    for (const step of curve.step) x.push(before + step);
    before += steps;
  }
  return CURVES.filter((curve) => rows.every((row) => row[curve.key])).map((curve) => {
    const chart = new Chart({ ...curve, refs: refsOf(curve, card.task), sync: `policy-${card.name}`, series: [{ label: curve.title, token: curve.token }] });
    chart.setData([x, rows.flatMap((row) => row[curve.key])]);
    return chart;
  });
}

/** Show the page in `root`. */
export async function mount(root, { id, signal }) {
  document.title = `${id} · Policies · naosprint`;
  const parts = [];
  const keep = (part) => { parts.push(part); return part; };
  const section = (title, ...kids) => h("section", { class: "card" }, h("div", { class: "card-head" }, h("h2", null, title)), kids);
  const draw = async () => {
    fill(root, h("div", { class: "card" }, loading("Loading the policy")));
    let card;
    try {
      card = await call(`policies/${encodeURIComponent(id)}`, { signal });
    } catch (error) {
      if (error.name !== "AbortError") fill(root, problem(error, draw));
      return;
    }
    const { figures, evaluation, spec } = card;
    const stage = h("section", { class: "card", "aria-label": "Replay" }), training = h("div", { class: "pad spec-columns" }), judging = h("div", { class: "pad spec-columns" });
    const tell = (known) => {
      fill(training, specList(spec, known?.training, known ? departures(spec, known.presets) : undefined));
      fill(judging, specList(evaluation, known?.judging));
    };
    const charts = curves(card).map(keep);
    fill(root,
      h("div", { class: "page-head" }, h("div", { class: "grow" }, h("div", { class: "crumbs" }, h("a", { href: "#/policies" }, "Policies")), h("h1", null, card.name)), h("div", { class: "row wrap" }, tags(card))),
      h("div", { class: "stack" },
        figuresBlock(card), stage,
        section("How to use it", usage(card.name)),
        section(`Figures of ${integer(figures.episodes)} episodes`, scroller("Figures", figuresTable(card))),
        speedByStartLine(figures, `${Math.round(evaluation.confidence * 100)} %`, (drawing) => keep(new Figure(drawing)).element),
        section("Lineage", scroller("Lineage", lineage(card))),
        h("div", { class: "charts three" }, charts.map((chart) => chart.element)),
        section("Training", training),
        section("Evaluation", judging)));
    tell(null);
    keep(new Player(stage, { path: `policies/${encodeURIComponent(id)}/replay`, task: evaluation.task, signal }));
    knowledge(signal).then(tell, () => { /* names and marks are an extra */ });
  };
  await draw();
  return { destroy: () => { for (const part of parts) part.destroy(); } };
}
