/** The studies: searches for settings. */

import { call } from "../api.js";
import { fill, h, scroller } from "../dom.js";
import { ago, stamp } from "../format.js";
import { loading, problem } from "./messages.js";
import { studyBadge } from "./study.js";

/** Show the page in `root`. */
export async function mount(root, { signal }) {
  document.title = "Studies · naosprint";
  const box = h("div", { class: "card" }, loading("Loading studies"));
  fill(root, h("div", { class: "page-head" }, h("h1", { class: "grow" }, "Studies")), box);
  const heading = (text, i) => h("th", { scope: "col", class: i > 2 ? "num" : null }, text);
  const row = (study) =>
    h(
      "tr",
      null,
      h("td", null, h("a", { href: `#/studies/${study.id}` }, study.name)),
      h("td", null, studyBadge(study.state)),
      h("td", null, study.spec.objectives.map((goal) => `${goal.direction} ${goal.metric}`).join(", ")),
      h("td", { class: "num" }, String(study.spec.trials)),
      h("td", { class: "num", title: stamp(study.created_at) }, ago(study.created_at)),
    );
  const draw = async () => {
    try {
      const { items } = await call("studies?limit=200", { signal });
      fill(
        box,
        items.length
          ? scroller(
              "Studies",
              h(
                "table",
                null,
                h("thead", null, h("tr", null, ["Study", "State", "Objectives", "Trials", "Started"].map(heading))),
                h("tbody", null, items.map(row)),
              ),
            )
          : h(
              "div",
              { class: "empty" },
              h("h2", null, "No studies yet"),
              h("p", null, "A study searches for the best settings of a training: ", h("code", null, "naoctl tune")),
            ),
      );
    } catch (error) {
      if (error.name !== "AbortError") fill(box, problem(error, draw));
    }
  };
  await draw();
  const timer = setInterval(draw, 10_000);
  return { destroy: () => clearInterval(timer) };
}
