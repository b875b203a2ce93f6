/** Workers: what they can run and when they were last seen. */

import { call, every, may } from "../api.js";
import { busy, fill, h, heading, icon, scroller, table, toast } from "../dom.js";
import { ago, bytes, duration, stamp } from "../format.js";
import { loading, refreshed } from "./messages.js";

const REFRESH_MS = 10_000;
const HEADINGS = ["Worker", "State", "Queues", "Robots", "Works on", "Version", "Free disk", "Up for", "Last seen"];

const NONE = h(
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
);

const tags = (names) =>
  h(
    "div",
    { class: "row wrap" },
    names.map((name) => h("span", { class: "tag" }, name)),
  );

/** Button that drains a worker, or ends that. */
function drainButton(w) {
  const verb = w.drained_at ? "undrain" : "drain";
  const press = async () => {
    try {
      const body = w.drained_at ? undefined : { requeue: true };
      await busy(button, () => call(`workers/${encodeURIComponent(w.id)}/${verb}`, { method: "POST", body }));
      toast(w.drained_at ? `${w.host} claims work again.` : `${w.host} claims no more work; its trainings move on.`);
      w.drained_at = w.drained_at ? null : "now";
      fill(button.parentElement, drainButton(w));
    } catch (error) {
      toast(error.message, "error");
    }
  };
  const title = w.drained_at ? "Let it claim work again" : "Claim no more work, and requeue its trainings";
  const button = h("button", { class: "small", title, onclick: press }, w.drained_at ? "Undrain" : "Drain");
  return button;
}

const row = (w) =>
  h(
    "tr",
    null,
    h("td", null, h("div", null, w.host), h("div", { class: "mono muted" }, w.id)),
    h(
      "td",
      null,
      h(
        "span",
        { class: "state", "data-tone": w.drained_at ? "amber" : w.alive ? "green" : "red" },
        icon(w.drained_at ? "pause" : w.alive ? "check" : "close"),
        w.alive ? (w.drained_at ? "Drained" : "Alive") : "Silent",
      ),
    ),
    h("td", null, tags(w.simulators)),
    h("td", { title: `Tasks: ${Object.keys(w.tasks).sort().join(", ")}` }, tags(w.robots)),
    h(
      "td",
      null,
      w.jobs.length + w.evaluations.length + w.matches.length
        ? [
            ...w.jobs.map((id) => h("div", null, h("a", { class: "mono", href: `#/jobs/${id}` }, id))),
            ...w.evaluations.map((id) => h("div", { class: "mono" }, id)),
            ...w.matches.map((id) => h("div", null, h("a", { class: "mono", href: `#/matches/${id}` }, id))),
          ]
        : h("span", { class: "muted" }, "nothing"),
    ),
    h("td", { class: "mono" }, w.version),
    h("td", { class: "num" }, bytes(w.disk_free_bytes)),
    h("td", { class: "num", title: stamp(w.started_at) }, duration((Date.now() - new Date(w.started_at)) / 1000)),
    h("td", { class: "num", title: stamp(w.heartbeat_at) }, ago(w.heartbeat_at)),
    may("admin") ? h("td", null, drainButton(w)) : null,
  );

/** Show the page in `root`. */
export async function mount(root, { signal }) {
  document.title = "Workers · naosprint";
  const box = h("div", { class: "card" }, loading("Loading workers"));
  fill(root, h("div", { class: "page-head" }, h("h1", { class: "grow" }, "Workers")), box);
  const read = async () => {
    const workers = await every("workers", { signal });
    if (!workers.length) return NONE;
    const headings = HEADINGS.map((title, i) => heading(title, i > 5));
    if (may("admin")) headings.push(h("th", { scope: "col" }, h("span", { class: "sr" }, "Actions")));
    return scroller("Workers", table(headings, workers.map(row)));
  };
  await refreshed(box, read, REFRESH_MS, signal);
}
