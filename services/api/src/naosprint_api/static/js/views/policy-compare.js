/** Some policies beside each other: their results, and the settings that differ. */

import { call } from "../api.js";
import { fill, h, scroller } from "../dom.js";
import { integer, intervalText, withUnit } from "../format.js";
import { loading, problem } from "./messages.js";
import { pageOf } from "./policies.js";
import { flattened, show } from "./spec-list.js";

const NONE = "–";

function comparison(cards) {
  const specs = cards.map((card) => flattened(card.spec));
  const paths = [...new Set(specs.flatMap((spec) => Object.keys(spec)))];
  const differing = paths.filter((path) => new Set(specs.map((spec) => JSON.stringify(spec[path]))).size > 1);
  const results = cards.map((card) => new Map(card.results.map((r) => [r.name, r])));
  const titles = new Map(cards.flatMap((card) => card.results.map((r) => [r.name, r.title])));
  const row = (title, cells) =>
    h(
      "tr",
      null,
      h("th", { scope: "row" }, title),
      cells.map((cell) => h("td", { class: "num" }, cell)),
    );
  const value = (r) => (r ? [withUnit(r, r.value), h("div", { class: "muted" }, intervalText(r, r.interval))] : NONE);
  return h(
    "table",
    { class: "plain", "data-part": "comparison" },
    h(
      "thead",
      null,
      h(
        "tr",
        null,
        h("th", { scope: "col" }, "Policy"),
        cards.map((card) => h("th", { scope: "col", class: "num" }, h("a", { href: pageOf(card) }, card.reference))),
      ),
    ),
    h(
      "tbody",
      null,
      row(
        "Aliases",
        cards.map((card) => card.aliases.join(", ") || NONE),
      ),
      row(
        "Steps",
        cards.map((card) => integer(card.steps)),
      ),
      row(
        "Started from",
        cards.map((card) => card.parent_policy ?? NONE),
      ),
      row(
        "Episodes",
        cards.map((card) => (card.episodes ? integer(card.episodes) : NONE)),
      ),
      [...titles].map(([name, title]) =>
        row(
          title,
          results.map((found) => value(found.get(name))),
        ),
      ),
      differing.map((path) =>
        row(
          h("code", null, path),
          specs.map((spec) => (path in spec ? show(spec[path]) : NONE)),
        ),
      ),
    ),
  );
}

/** Show the page in `root`. */
export async function mount(root, { params, signal }) {
  document.title = "Policies compared · naosprint";
  const box = h("div", { class: "card" }, loading("Loading policies"));
  const head = h(
    "div",
    { class: "grow" },
    h("div", { class: "crumbs" }, h("a", { href: "#/policies" }, "Policies")),
    h("h1", null, "Policies compared"),
  );
  fill(root, h("div", { class: "page-head" }, head), box);
  const draw = async () => {
    try {
      const names = (params.get("of") ?? "").split(",").filter(Boolean);
      const cards = await Promise.all(names.map((name) => call(`policies/${encodeURIComponent(name)}`, { signal })));
      fill(box, scroller("Comparison", comparison(cards)));
    } catch (error) {
      if (error.name !== "AbortError") fill(box, problem(error, draw));
    }
  };
  await draw();
}
