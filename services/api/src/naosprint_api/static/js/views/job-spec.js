/** Full specification of a job, with the names of the form; overrides of its preset are marked. */

import { save } from "../api.js";
import { fill, h, icon, toast } from "../dom.js";
import { knowledge, overrides, specList } from "./spec-list.js";

export class SpecTab {
  constructor(root, store) {
    this.store = store;
    const { job } = store;
    this.text = JSON.stringify(
      { name: job.name, tags: job.tags, spec: job.spec, evaluation: job.evaluation, priority: job.priority },
      null,
      2,
    );
    this.training = h("div", { class: "pad spec-columns" });
    this.evaluated = h("div", { class: "pad spec-columns" });
    fill(
      root,
      h(
        "div",
        { class: "stack" },
        h(
          "section",
          { class: "card" },
          h(
            "div",
            { class: "card-head" },
            h("h2", null, "Training"),
            h("button", { class: "ghost small", onclick: () => this.copy() }, icon("copy"), "Copy JSON"),
            h(
              "button",
              {
                class: "ghost small",
                onclick: () => save(new Blob([this.text], { type: "application/json" }), `${job.name}.json`),
              },
              icon("download"),
              "Save",
            ),
          ),
          this.training,
        ),
        h("section", { class: "card" }, h("div", { class: "card-head" }, h("h2", null, "Evaluation")), this.evaluated),
        h(
          "section",
          { class: "card" },
          h("div", { class: "card-head" }, h("h2", null, "Job")),
          h(
            "div",
            { class: "pad spec-columns" },
            specList({
              id: job.id,
              owner: job.owner,
              priority: job.priority,
              attempt: job.attempt,
              failures: job.failures,
              max_attempts: job.max_attempts,
              group: job.group_id,
              parent: job.parent_job_id,
            }),
          ),
        ),
      ),
    );
    this.draw(null);
    knowledge(store.signal).then(
      (known) => this.draw(known),
      () => {
        /* names and marks are an extra */
      },
    );
  }

  draw(known) {
    const { job } = this.store;
    const fields = known?.training(job.spec);
    fill(
      this.training,
      specList(
        job.spec,
        fields,
        known ? overrides(job.spec, known.presets, known.families.get(job.spec.robot?.name), fields) : undefined,
      ),
    );
    fill(
      this.evaluated,
      job.evaluation
        ? specList(job.evaluation, known?.evaluation)
        : h(
            "p",
            { class: "muted" },
            "The final policy is not evaluated automatically; start an evaluation under Evaluation.",
          ),
    );
  }

  copy() {
    navigator.clipboard.writeText(this.text).then(
      () => toast("Copied as JSON."),
      () => toast("The browser denied access to the clipboard.", "error"),
    );
  }
}
