/** The policies in the box: one card each with what it can do and how it came about. */

import { call } from "../api.js";
import { fill, h, icon } from "../dom.js";
import { compact, duration, fixed, integer, percent } from "../format.js";
import { loading, problem } from "./messages.js";

/** Headline figures of a policy's card: label, value, unit, note and what the figure means. */
export function headline({ figures: f, evaluation, ...card }) {
  const { mean, sd } = f.paper.deviation_deg;
  const level = `${Math.round(evaluation.confidence * 100)} %`;
  return [
    ["Top speed", fixed(f.paper.top_speed_mps), "m/s", f.paper.top_speed_sd_mps === null ? "too few long episodes" : `sd ${fixed(f.paper.top_speed_sd_mps)}`, "The paper’s measure: best start line, over episodes with 200 samples beyond it"],
    ["Mean speed", fixed(f.speed_mps.mean), "m/s", "all episodes", `Mean of distance over time from the start, over ${integer(f.episodes)} episodes`],
    ["Falls", percent(f.falls.rate), null, `${integer(f.falls.count)} of ${integer(f.episodes)}`, f.falls.ci ? `${level} interval ${percent(f.falls.ci[0])} to ${percent(f.falls.ci[1])}` : null],
    ["Deviation", fixed(mean), "°", `sd ${fixed(sd)}°`, "Angle between the running direction and the line from start to end"],
    ["Trained", compact(card.steps), "steps", card.lineage.length > 1 ? `${card.lineage.length} jobs` : "1 job", `${integer(card.steps)} environment steps`],
    ["Took", duration(card.training_s), null, "wall-clock", null],
  ];
}

/** Headline figures as a block; `flat` inside of a card. */
export const figuresBlock = (card, flat) => h("div", { class: ["stats", flat && "flat", "six"] }, headline(card).map(([label, value, unit, note, title]) =>
  h("div", { title }, h("div", { class: "k" }, label), h("div", { class: "v" }, value, unit && value !== "–" ? h("span", { class: "unit" }, unit) : null), h("div", { class: "d" }, note))));

/** A policy's robot and task as tags. */
export const tags = (card) => [h("span", { class: "tag" }, card.task), h("span", { class: "tag" }, `robot type ${card.robot_type}`)];

/** The jobs behind a policy in a line, first to last. */
const descent = (card) => card.lineage.map((one) => `${one.task}, preset ${one.preset}, ${compact(one.steps)} steps`).join(" → ");

function cardOf(card) {
  const href = `#/policies/${card.name}`;
  return h("section", { class: "card policy", "data-policy": card.name },
    h("div", { class: "card-head wrap" }, h("h2", null, h("a", { href }, card.name)), tags(card)),
    h("p", { class: "pad soft" }, "From random weights → ", descent(card)),
    figuresBlock(card, true),
    h("div", { class: "row pad" }, h("a", { class: "button small", href, "aria-label": `Watch it run: ${card.name}` }, icon("play"), "Watch it run")));
}

/** Show the page in `root`. */
export async function mount(root, { signal }) {
  document.title = "Policies · naosprint";
  const box = h("div");
  fill(root, h("div", { class: "page-head" }, h("div", { class: "grow" }, h("h1", null, "Policies"), h("p", { class: "soft" }, "Trained robots that come with naosprint. Each says how it was trained and judged."))), box);
  const draw = async () => {
    fill(box, h("div", { class: "card" }, loading("Loading policies")));
    try {
      const cards = await call("policies", { signal });
      fill(box, cards.length ? h("div", { class: "charts" }, cards.map(cardOf))
        : h("div", { class: "card empty" }, h("h2", null, "No policies are shipped with this version"), h("p", null, "Train one: a job's checkpoints can be watched, judged and exported just the same."), h("div", { class: "row" }, h("a", { class: "button primary", href: "#/submit" }, icon("plus"), "New job"))));
    } catch (error) {
      if (error.name !== "AbortError") fill(box, problem(error, draw));
    }
  };
  await draw();
}
