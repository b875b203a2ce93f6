/** The full specification of a job, named as the form names it, with what departs from its preset marked. */

import { call, save } from "../api.js";
import { fill, h, icon, toast } from "../dom.js";
import { words } from "../format.js";
import { field, resolve } from "../schema.js";

const NOT_PRESET = new Set(["task", "robot_type", "simulator", "seed", "preset", "min_height", "total_steps"]);

const show = (v) => (v === null ? "none" : Array.isArray(v) ? v.join(" × ") : typeof v === "boolean" ? (v ? "yes" : "no") : typeof v === "number" && Math.abs(v) >= 1e4 ? v.toLocaleString("en-US") : String(v));

/** Names, units and hints of the fields of an object by field name; empty while the schema is not known. */
function fieldsOf(properties, schema) {
  return new Map(Object.entries(properties ?? {}).map(([name, property]) => [name, field(name, property, schema)]));
}

export class SpecTab {
  constructor(root, store) {
    this.store = store;
    const { job } = store;
    this.text = JSON.stringify({ name: job.name, tags: job.tags, spec: job.spec, evaluation: job.evaluation, priority: job.priority }, null, 2);
    this.training = h("div", { class: "pad spec-columns" });
    this.judging = h("div", { class: "pad spec-columns" });
    fill(root, h("div", { class: "stack" },
      h("section", { class: "card" }, h("div", { class: "card-head" }, h("h2", null, "Training"), h("button", { class: "ghost small", onclick: () => this.copy() }, icon("copy"), "Copy JSON"),
        h("button", { class: "ghost small", onclick: () => save(new Blob([this.text], { type: "application/json" }), `${job.name}.json`) }, icon("download"), "Save")), this.training),
      h("section", { class: "card" }, h("div", { class: "card-head" }, h("h2", null, "Evaluation")), this.judging),
      h("section", { class: "card" }, h("div", { class: "card-head" }, h("h2", null, "Job")), h("div", { class: "pad spec-columns" },
        this.list({ id: job.id, owner: job.owner, priority: job.priority, queue: job.queue, attempt: job.attempt, failures: job.failures, max_attempts: job.max_attempts, group: job.group_id, parent: job.parent_job_id })))));
    this.draw(null, null);
    Promise.all([call("spec/schema", { signal: store.signal }), call("presets", { signal: store.signal })]).then(([schema, presets]) => this.draw(schema, presets), () => { /* names and marks are an extra */ });
  }

  draw(schema, presets) {
    const { job } = this.store;
    const properties = schema && resolve(schema, schema).properties;
    const judging = properties?.evaluation?.anyOf?.find((o) => o.type !== "null") ?? properties?.evaluation;
    const base = presets?.find((p) => p.name === job.spec.preset)?.spec;
    const changed = new Set(base ? Object.keys(base).filter((k) => !NOT_PRESET.has(k) && JSON.stringify(base[k]) !== JSON.stringify(job.spec[k])) : []);
    fill(this.training, this.list(job.spec, fieldsOf(properties && resolve(properties.spec, schema).properties, schema), changed));
    fill(this.judging, job.evaluation ? this.list(job.evaluation, fieldsOf(judging && resolve(judging, schema).properties, schema)) : h("p", { class: "muted" }, "The final policy is not evaluated by itself; ask for it under Evaluation."));
  }

  list(values, fields = new Map(), changed = new Set()) {
    return h("dl", null, Object.entries(values).map(([key, value]) => {
      const known = fields.get(key);
      return h("div", { class: "pair", title: known?.hint }, h("dt", null, known?.label ?? words(key)), h("dd", { class: changed.has(key) ? "changed" : null }, show(value), known?.unit && value !== null ? h("span", { class: "unit" }, known.unit) : null, changed.has(key) ? h("span", { class: "sr" }, " (departs from the preset)") : null));
    }));
  }

  copy() {
    navigator.clipboard.writeText(this.text).then(() => toast("Copied as JSON."), () => toast("The browser refused the clipboard.", "error"));
  }
}
