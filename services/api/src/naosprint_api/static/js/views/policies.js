/** The policies, bundled and registered: one card each with its results and its lineage; compare some. */

import { every } from "../api.js";
import { fill, h, icon } from "../dom.js";
import { compact, duration, integer } from "../format.js";
import { loading, refreshed } from "./messages.js";
import { headlineStats, stat } from "./results.js";

/** Headline of a policy's card as a block; `flat` inside of a card, in rows of three. */
export function headlineBlock(card, flat) {
  const jobs = card.lineage.length > 1 ? `${card.lineage.length} jobs` : "1 job";
  const cells = [
    ...headlineStats(card),
    stat(
      "Trained",
      compact(card.steps),
      "steps",
      `${jobs}, ${duration(card.training_s)}`,
      `${integer(card.steps)} environment steps`,
    ),
  ];
  while (flat && cells.length % 3) cells.push(h("div"));
  return h("div", { class: ["stats", flat && "flat", "six"] }, cells);
}

/** A policy's aliases, robot and task as tags. */
export const tags = (card) => [...card.aliases, card.task, card.robot].map((text) => h("span", { class: "tag" }, text));

/** The address of a policy's page. */
export const pageOf = (card) =>
  `#/policies/${card.reference}${card.owner ? `?owner=${encodeURIComponent(card.owner)}` : ""}`;

/** The jobs behind a policy in a line, first to last. */
const descent = (card) =>
  card.lineage.map((one) => `${one.task}, preset ${one.preset}, ${compact(one.steps)} steps`).join(" → ");

function cardOf(card, chosen, choose) {
  const href = pageOf(card);
  const box = h("input", {
    type: "checkbox",
    checked: chosen.has(card.reference),
    "aria-label": `Compare ${card.reference}`,
    onchange: () => choose(card, box.checked),
  });
  return h(
    "section",
    { class: "card policy", "data-policy": card.name },
    h("div", { class: "card-head wrap" }, h("h2", null, h("a", { href }, card.reference)), tags(card), box),
    h("p", { class: "pad soft" }, "From random weights → ", descent(card)),
    headlineBlock(card, true),
    h(
      "div",
      { class: "row pad" },
      h(
        "a",
        { class: "button small", href, "aria-label": `Watch it run: ${card.reference}` },
        icon("play"),
        "Watch it run",
      ),
    ),
  );
}

/** Show the page in `root`. */
export async function mount(root, { signal }) {
  document.title = "Policies · naosprint";
  const box = h("div", null, h("div", { class: "card" }, loading("Loading policies")));
  const chosen = new Set();
  const compare = h("a", { class: "button", hidden: true }, "Compare");
  const choose = (card, on) => {
    if (on) chosen.add(card.reference);
    else chosen.delete(card.reference);
    compare.hidden = chosen.size < 2;
    compare.href = `#/policies-compared?of=${[...chosen].join(",")}`;
  };
  fill(
    root,
    h(
      "div",
      { class: "page-head" },
      h(
        "div",
        { class: "grow" },
        h("h1", null, "Policies"),
        h(
          "p",
          { class: "soft" },
          "Bundled policies, and the newest version of each that was registered from a job's checkpoints.",
        ),
      ),
      compare,
    ),
    box,
  );
  const none = h(
    "div",
    { class: "card empty" },
    h("h2", null, "No policies are bundled with this version"),
    h("p", null, "Train one: a job's checkpoints can be watched, evaluated and exported too."),
    h("div", { class: "row" }, h("a", { class: "button primary", href: "#/submit" }, icon("plus"), "New job")),
  );
  await refreshed(box, async () => {
    const cards = await every("policies", { signal });
    return cards.length
      ? h(
          "div",
          { class: "charts" },
          cards.map((card) => cardOf(card, chosen, choose)),
        )
      : none;
  });
}
