/** The studies: searches for settings. */

import { may } from "../api.js";
import { descriptions } from "../descriptions.js";
import { fill, h, heading, icon, scroller, table } from "../dom.js";
import { ago, stamp } from "../format.js";
import { listed, loading } from "./messages.js";
import { objectives, studyBadge } from "./study.js";

const REFRESH_MS = 10_000;
const HEADINGS = ["Study", "State", "Objectives", "Trials", "Started"];

const NONE = h(
  "div",
  { class: "empty" },
  h("h2", null, "No studies yet"),
  h(
    "p",
    null,
    "A study searches for the best settings of a training. From a terminal: ",
    h("code", null, "naoctl tune"),
  ),
);

const row = (study, known) =>
  h(
    "tr",
    null,
    h("td", null, h("a", { href: `#/studies/${study.id}` }, study.name)),
    h("td", null, studyBadge(study.state)),
    h("td", null, objectives(study, known)),
    h("td", { class: "num" }, String(study.spec.trials)),
    h("td", { class: "num", title: stamp(study.created_at) }, ago(study.created_at)),
  );

/** Show the page in `root`. */
export async function mount(root, { signal }) {
  document.title = "Studies · naosprint";
  const box = h("div", { class: "card" }, loading("Loading studies"));
  const start = may("submit")
    ? h("a", { class: "button primary", href: "#/submit?study=1" }, icon("plus"), "New study")
    : null;
  fill(root, h("div", { class: "page-head" }, h("h1", { class: "grow" }, "Studies"), start), box);
  const draw = async (items) => {
    if (!items.length) return NONE;
    const known = await descriptions();
    const headings = HEADINGS.map((title, i) => heading(title, i > 2));
    return scroller(
      "Studies",
      table(
        headings,
        items.map((study) => row(study, known)),
      ),
    );
  };
  await listed(box, "studies", draw, REFRESH_MS, signal);
}
