/** Workers: what they can run and when they were last seen. */

import { call } from "../api.js";
import { fill, h, icon, scroller } from "../dom.js";
import { ago, duration, stamp } from "../format.js";
import { loading, problem } from "./messages.js";

/** Show the page in `root`. */
export async function mount(root, { signal }) {
  document.title = "Workers · naosprint";
  const box = h("div", { class: "card" }, loading("Loading workers"));
  fill(root, h("div", { class: "page-head" }, h("h1", { class: "grow" }, "Workers")), box);
  const draw = async () => {
    try {
      const workers = await call("workers", { signal });
      if (!workers.length) {
        fill(
          box,
          h(
            "div",
            { class: "empty" },
            h("h2", null, "No worker has reported"),
            h(
              "p",
              null,
              "Jobs wait in the queue until one does. ",
              h("code", null, "naoctl up"),
              " starts one on this machine; ",
              h("code", null, "python -m naosprint_worker"),
              " starts one anywhere that reaches the database, broker and store.",
            ),
          ),
        );
        return;
      }
      fill(
        box,
        scroller(
          "Workers",
          h(
            "table",
            null,
            h(
              "thead",
              null,
              h(
                "tr",
                null,
                ["Worker", "State", "Runs", "Jobs", "Version", "Up for", "Last seen"].map((t, i) =>
                  h("th", { scope: "col", class: i > 4 ? "num" : null }, t),
                ),
              ),
            ),
            h(
              "tbody",
              null,
              workers.map((w) =>
                h(
                  "tr",
                  null,
                  h("td", null, h("div", null, w.host), h("div", { class: "mono muted" }, w.id)),
                  h(
                    "td",
                    null,
                    h(
                      "span",
                      { class: "state", "data-tone": w.alive ? "green" : "red" },
                      icon(w.alive ? "check" : "close"),
                      w.alive ? "Alive" : "Silent",
                    ),
                  ),
                  h(
                    "td",
                    null,
                    h(
                      "div",
                      { class: "row wrap" },
                      w.queues.map((q) => h("span", { class: "tag" }, q)),
                    ),
                  ),
                  h(
                    "td",
                    null,
                    w.jobs.length
                      ? w.jobs.map((id) => h("div", null, h("a", { class: "mono", href: `#/jobs/${id}` }, id)))
                      : h("span", { class: "muted" }, "nothing"),
                  ),
                  h("td", { class: "mono" }, w.version),
                  h(
                    "td",
                    { class: "num", title: stamp(w.started_at) },
                    duration((Date.now() - new Date(w.started_at)) / 1000),
                  ),
                  h("td", { class: "num", title: stamp(w.heartbeat_at) }, ago(w.heartbeat_at)),
                ),
              ),
            ),
          ),
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
