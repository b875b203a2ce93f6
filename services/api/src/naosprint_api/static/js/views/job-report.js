/** The report and the film of a job's evaluation, as the worker stored them. */

import { call, url } from "../api.js";
import { fill, h, icon } from "../dom.js";
import { FILM, representative, requestEvaluation } from "../evaluation.js";
import { isEnded } from "../states.js";
import { fetchInto } from "./job-checkpoints.js";
import { RecordedTab } from "./job-recorded.js";
import { notice } from "./messages.js";

const PAGE = "report.html";
const FILM_FILE = "run.mp4";

export class ReportTab extends RecordedTab {
  /** The buttons that have a worker draw a report of the newest checkpoint, with many episodes or with few. */
  tools(open) {
    const { checkpoints } = this.store;
    const ask = (action, label, title, body, done) => {
      const request = async () => {
        const made = await requestEvaluation(this.store, button, body, done);
        this.wanted = made?.id ?? this.wanted;
      };
      const props = { "data-action": action, title, disabled: !checkpoints?.length || open, onclick: request };
      const button = h("button", props, label);
      return button;
    };
    return [
      ask(
        "report",
        "Make report",
        "Evaluate the newest checkpoint, and draw curves, results and a film",
        { report: "film" },
        "A worker will evaluate the newest checkpoint and draw the report.",
      ),
      ask(
        "film",
        "Film the newest checkpoint",
        "Run a few episodes and film one",
        FILM,
        "A worker will film the newest checkpoint.",
      ),
    ];
  }

  empty(open) {
    return h(
      "div",
      { class: "card empty" },
      h("h2", null, open ? "A worker draws it" : "No report yet"),
      h(
        "p",
        null,
        open
          ? "It evaluates the policy first; the report opens here when it is done."
          : "A worker evaluates the policy, and draws a page with curves, results and a film. From a terminal: ",
        open ? null : h("code", null, `naoctl report ${this.store.job.name}`),
      ),
      h("div", { class: "row" }, this.tools(open)),
    );
  }

  async draw() {
    if (this.gone) return;
    const file = (evaluation, name) => evaluation.files.find((f) => f.name === name);
    const evaluations = this.store.evaluations ?? [];
    const reported = evaluations.filter((e) => e.state === "succeeded" && file(e, PAGE));
    const open = evaluations.some((e) => !isEnded(e.state) && e.report && e.report !== "off");
    const chosen = reported.find((e) => e.id === this.wanted) ?? representative(reported) ?? reported[0];
    const key = JSON.stringify([chosen?.id, reported.length, open, Boolean(this.store.checkpoints?.length)]);
    if (key === this.shown) return;
    this.shown = key;
    if (!chosen) {
      fill(this.root, this.empty(open));
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
      if (this.gone || this.shown !== key) return;
      const address = url(page.url).href;
      fill(
        this.root,
        this.head(
          "Which report",
          "report",
          reported,
          chosen,
          open ? h("span", { class: "muted" }, "A worker draws another one.") : null,
          this.tools(open),
        ),
        h(
          "section",
          { class: "card" },
          h(
            "div",
            { class: "card-head wrap" },
            h("h2", null, "Report"),
            h("a", { class: "button small", href: address, target: "_blank", rel: "noreferrer" }, "Open in a new tab"),
            save(PAGE, "Report"),
            save(FILM_FILE, "Film"),
          ),
          h("iframe", { class: "report", src: address, title: `Report of ${this.store.job.name}` }),
        ),
      );
    } catch (error) {
      if (error.name !== "AbortError")
        fill(this.root, notice("error", "The report could not be opened.", error.message));
    }
  }
}
