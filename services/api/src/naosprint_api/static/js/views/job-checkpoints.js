/** The checkpoints of a job: download, evaluate, register, start another job from one. */

import { download } from "../api.js";
import { busy, fill, h, heading, icon, scroller, setText, table, toast } from "../dom.js";
import { FILM, requestEvaluation } from "../evaluation.js";
import { ago, bytes, integer, stamp } from "../format.js";
import { registerCheckpoint } from "./job-edit.js";
import { notice } from "./messages.js";

/** Download a file that needs the token; the button is disabled meanwhile. */
export const fetchInto = (button, path, name) =>
  busy(button, () => download(path, name)).catch((error) => toast(`${name}: ${error.message}`, "error"));

export class CheckpointsTab {
  constructor(root, store) {
    this.root = root;
    this.store = store;
    this.rows = new Map();
    store.on("checkpoints", () => this.draw());
    this.draw();
  }

  draw() {
    if (this.gone) return;
    const { job, checkpoints } = this.store;
    if (!checkpoints?.length) {
      fill(
        this.root,
        h(
          "div",
          { class: "card empty" },
          h("h2", null, "No checkpoint yet"),
          h(
            "p",
            null,
            `One is saved every ${integer(job.spec.runtime?.checkpoint_interval_steps)} steps and at the end. A paused or interrupted job resumes from its newest checkpoint.`,
          ),
        ),
      );
      return;
    }
    // Existing rows stay, so that open details do not close when a checkpoint arrives.
    for (const c of checkpoints) if (!this.rows.has(c.id)) this.rows.set(c.id, this.row(c));
    const rows = checkpoints.map((c) => this.rows.get(c.id));
    checkpoints.forEach((c, i) => setText(rows[i].querySelector("[data-age]"), ago(c.created_at)));
    if (this.body?.isConnected) {
      for (const old of [...this.body.children]) if (!rows.includes(old)) old.remove();
      rows.forEach((row, i) => {
        if (this.body.children[i] !== row) this.body.insertBefore(row, this.body.children[i] ?? null);
      });
      return;
    }
    this.body = h("tbody", null, rows);
    fill(
      this.root,
      h(
        "section",
        { class: "card" },
        scroller(
          "Checkpoints",
          table(
            [
              heading("Step", true),
              heading("Attempt", true),
              heading("Saved"),
              heading("Size", true),
              heading("Files"),
              heading(h("span", { class: "sr" }, "Actions")),
            ],
            this.body,
          ),
        ),
      ),
      h(
        "div",
        { style: { "margin-top": "1rem" } },
        notice("info", "From a terminal:", h("code", null, `naoctl download ${job.id}`), " "),
      ),
    );
  }

  row(c) {
    const { job } = this.store;
    const all = h(
      "button",
      { class: "small", onclick: () => fetchInto(all, c.archive_url, `${job.name}-${c.step}.tar`) },
      icon("download"),
      "Download",
    );
    const step = `Step ${integer(c.step)}`;
    const ask = (label, title, body, done) => {
      const request = () => requestEvaluation(this.store, button, { checkpoint_id: c.id, ...body }, done);
      const button = h("button", { class: "small", title, onclick: request }, label);
      return button;
    };
    const evaluate = ask("Evaluate", "Measure this policy", {}, `${step} will be evaluated.`);
    const film = ask(
      "Film",
      "Run a few episodes and film one; the film appears under Report",
      FILM,
      `${step} will be filmed; the film appears under Report.`,
    );
    const files = h(
      "details",
      null,
      h("summary", { class: "muted" }, c.files.length === 1 ? "1 file" : `${c.files.length} files`),
      h(
        "ul",
        { class: "list" },
        c.files.map((f) => {
          const get = h(
            "button",
            { class: "ghost square", "aria-label": `Download ${f.name}`, onclick: () => fetchInto(get, f.url, f.name) },
            icon("download"),
          );
          return h(
            "li",
            null,
            h("span", { class: "grow mono", title: `sha256 ${f.sha256}` }, f.name),
            h("span", { class: "muted nowrap" }, bytes(f.size)),
            get,
          );
        }),
      ),
    );
    return h(
      "tr",
      { "data-checkpoint": c.id },
      h("td", { class: "num" }, integer(c.step)),
      h("td", { class: "num" }, c.attempt),
      h("td", { class: "nowrap muted", "data-age": true, title: stamp(c.created_at) }, ago(c.created_at)),
      h("td", { class: "num" }, bytes(c.size)),
      h("td", null, files),
      h(
        "td",
        null,
        h(
          "div",
          { class: "row end" },
          all,
          evaluate,
          film,
          h("button", { class: "small", onclick: () => registerCheckpoint(job, c) }, "Register"),
          h(
            "a",
            { class: "button small", href: `#/submit?parent=${job.id}&checkpoint=${c.id}` },
            icon("branch"),
            "Continue in a new job",
          ),
        ),
      ),
    );
  }

  destroy() {
    this.gone = true;
  }
}
