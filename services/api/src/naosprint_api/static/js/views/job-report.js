/** The report and the film of a job's evaluation, as the worker stored them. */

import { call, url } from "../api.js";
import { fill, h, icon } from "../dom.js";
import { representative } from "../evaluation.js";
import { fetchInto } from "./job-checkpoints.js";
import { notice } from "./messages.js";

const PAGE = "report.html";
const FILM = "run.mp4";

export class ReportTab {
  constructor(root, store) {
    this.root = root;
    this.store = store;
    store.on("evaluations", () => this.draw());
    this.draw();
  }

  async draw() {
    if (this.gone) return;
    const file = (evaluation, name) => evaluation.files.find((f) => f.name === name);
    const reported = (this.store.evaluations ?? []).filter((e) => e.state === "succeeded" && file(e, PAGE));
    const chosen = representative(reported) ?? reported[0];
    if (chosen && chosen.id === this.shown) return;
    this.shown = chosen?.id;
    if (!chosen) {
      fill(
        this.root,
        h(
          "div",
          { class: "card empty" },
          h("h2", null, "No report yet"),
          h(
            "p",
            null,
            "A worker stores one with every evaluation if it is started with ",
            h("code", null, "NAOSPRINT_WORKER_REPORT=film"),
            ". From a terminal, ",
            h("code", null, `naoctl report ${this.store.job.name}`),
            " makes one at any time.",
          ),
        ),
      );
      return;
    }
    const save = (name, label) => {
      const found = file(chosen, name);
      if (!found) return null;
      const button = h(
        "button",
        { class: "small", onclick: () => fetchInto(button, found.url, name) },
        icon("download"),
        label,
      );
      return button;
    };
    try {
      const page = await call(`evaluations/${chosen.id}/report`, { method: "POST", signal: this.store.signal });
      if (this.gone) return;
      const address = url(page.url).href;
      fill(
        this.root,
        h(
          "section",
          { class: "card" },
          h(
            "div",
            { class: "card-head wrap" },
            h("h2", null, "Report"),
            h("a", { class: "button small", href: address, target: "_blank", rel: "noreferrer" }, "Open in a new tab"),
            save(PAGE, "Report"),
            save(FILM, "Film"),
          ),
          h("iframe", { class: "report", src: address, title: `Report of ${this.store.job.name}` }),
        ),
      );
    } catch (error) {
      if (error.name !== "AbortError")
        fill(this.root, notice("error", "The report could not be opened.", error.message));
    }
  }

  destroy() {
    this.gone = true;
  }
}
