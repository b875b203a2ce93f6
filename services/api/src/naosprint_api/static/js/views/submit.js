/** Submit a job: a form made from the service's JSON schema and presets. */

import { call } from "../api.js";
import { fill, h, icon, setText, toast } from "../dom.js";
import { compact, integer, words } from "../format.js";
import { field, fromText, resolve, seeds, toText } from "../schema.js";
import { loading, notice } from "./messages.js";

/** Which fields stand together; those not named here come under "More settings", so that a new field is never lost. */
const SECTIONS = [
  ["Robot and task", ["task", "robot_type", "simulator", "total_steps", "seed", "min_height"], true],
  ["Rollouts and updates", ["n_envs", "n_steps", "batch_size", "n_epochs", "learning_rate", "learning_rate_schedule", "clip_range", "target_kl", "gamma", "gae_lambda"], false],
];

const sameValue = (a, b) => JSON.stringify(a ?? null) === JSON.stringify(b ?? null);

/** One field of the form: its control, what the user changed and what is wrong with it. */
class Field {
  constructor(spec, path, onChange) {
    this.spec = spec;
    this.path = path;
    this.touched = false;
    this.base = spec.fallback;
    const id = `f-${path.replace(/\W/g, "-")}`;
    const help = `${id}-help`;
    this.trouble = h("p", { class: "problem", id: `${id}-problem`, role: "alert" });
    const changed = () => {
      this.touched = !sameValue(this.peek(), this.base);
      this.paint();
      if (this.trouble.textContent && this.peek() !== undefined) this.fail("");
      onChange(this);
    };
    const common = { id, name: path, "aria-describedby": `${help} ${id}-problem` };
    if (spec.kind === "choice") this.control = h("select", { ...common, onchange: changed }, spec.choices.map((c, i) => h("option", { value: i }, c === null ? "none" : String(c))));
    else if (spec.kind === "flag") this.control = h("input", { ...common, type: "checkbox", onchange: changed });
    else this.control = h("input", { ...common, type: "text", autocomplete: "off", spellcheck: "false", inputmode: spec.kind === "integer" || spec.kind === "number" ? "decimal" : null, placeholder: spec.nullable ? "none" : null, oninput: changed, onblur: () => this.settle() });
    this.undo = h("button", { type: "button", class: "ghost reset", hidden: true, "aria-label": `Back to the preset's ${spec.label}`, onclick: () => { this.touched = false; this.set(this.base); this.fail(""); onChange(this); } }, "reset");
    const label = h("label", { for: id }, spec.kind === "flag" ? this.control : null, h("span", { class: "t" }, spec.label), spec.unit ? h("span", { class: "unit" }, spec.unit) : null, this.undo);
    this.element = h("div", { class: ["field", spec.kind === "flag" && "check"], "data-field": path }, label, spec.kind === "flag" ? null : this.control, h("p", { class: "hint", id: help }, spec.hint), this.trouble);
    this.set(this.base);
  }

  /** Set what applies unless the user says otherwise. */
  setBase(value) {
    this.base = value;
    if (!this.touched) this.set(value);
    else { this.touched = !sameValue(this.peek(), value); this.paint(); }
  }

  set(value) {
    if (this.spec.kind === "choice") this.control.value = String(Math.max(0, this.spec.choices.findIndex((c) => sameValue(c, value))));
    else if (this.spec.kind === "flag") this.control.checked = Boolean(value);
    else this.control.value = toText(this.spec, value);
    this.paint();
  }

  /** Set as if the user had typed it. */
  choose(value) {
    this.touched = !sameValue(value, this.base);
    this.set(value);
  }

  /** Return the value; throws when the text is none. */
  value() {
    if (this.spec.kind === "choice") return this.spec.choices[Number(this.control.value)];
    if (this.spec.kind === "flag") return this.control.checked;
    return this.spec.read ? this.spec.read(this.control.value) : fromText(this.spec, this.control.value);
  }

  peek() {
    try { return this.value(); } catch { return undefined; }
  }

  settle() {
    try {
      this.value();
      this.fail("");
    } catch (error) { this.fail(error.message); }
  }

  fail(message) {
    this.trouble.textContent = message;
    if (message) this.control.setAttribute("aria-invalid", "true");
    else this.control.removeAttribute("aria-invalid");
  }

  paint() {
    this.element.classList.toggle("changed", this.touched);
    this.undo.hidden = !this.touched;
  }
}

class SubmitView {
  constructor(root, { params, signal, go }) {
    this.root = root;
    this.params = params;
    this.signal = signal;
    this.go = go;
    this.fields = new Map();
    // One key per form: pressing the button twice, or again after a lost answer, makes one job.
    this.key = crypto.randomUUID?.() ?? String(Math.random());
  }

  async start() {
    document.title = "New job · naosprint";
    fill(this.root, h("div", { class: "card" }, loading("Loading the form")));
    const from = this.params.get("from") ?? this.params.get("parent");
    const [schema, presets, tasks, model] = await Promise.all([
      call("spec/schema", { signal: this.signal }), call("presets", { signal: this.signal }), call("tasks", { signal: this.signal }), from ? call(`jobs/${encodeURIComponent(from)}`, { signal: this.signal }) : null]);
    this.schema = schema;
    this.presets = new Map(presets.map((p) => [p.name, p]));
    this.tasks = new Map(tasks.map((t) => [t.name, t]));
    this.model = model;
    this.build();
  }

  build() {
    const { schema } = this;
    const job = resolve(schema, schema).properties;
    const training = resolve(job.spec, schema).properties;
    const judging = field("evaluation", job.evaluation, schema) && resolve((job.evaluation.anyOf ?? [job.evaluation]).find((o) => o.type !== "null"), schema).properties;
    const make = (name, property, path) => {
      const spec = field(name, property, schema);
      const f = new Field(spec, path, () => this.changed());
      this.fields.set(path, f);
      return f;
    };
    for (const [name, property] of Object.entries(training)) if (name !== "preset") make(name, property, `spec.${name}`);
    for (const [name, property] of Object.entries(judging)) if (name !== "task") make(name, property, `evaluation.${name}`);
    for (const name of ["name", "tags", "priority", "max_attempts"]) if (job[name]) make(name, job[name], name);
    const seed = this.fields.get("spec.seed");
    if (seed) {
      seed.spec = { ...seed.spec, hint: `${seed.spec.hint} Several, as 0, 1, 2 or 0-4, make a group of jobs.`, read: (text) => { const all = seeds(text); return all.length === 1 ? all[0] : all; } };
      seed.element.querySelector(".hint").textContent = seed.spec.hint;
    }
    const tags = this.fields.get("tags");
    if (tags) tags.spec = { ...tags.spec, read: (text) => text.split(/[\s,]+/).filter(Boolean) };
    const name = this.fields.get("name");
    if (name) name.control.placeholder = "named after task, preset and seed";
    const height = this.fields.get("spec.min_height");
    if (height) height.control.placeholder = "the task's own";

    const element = (path) => this.fields.get(path)?.element;
    const group = (paths) => h("div", { class: "fields" }, paths.map(element));
    const placed = new Set(SECTIONS.flatMap(([, names]) => names));
    const rest = Object.keys(training).filter((n) => n !== "preset" && !placed.has(n));
    const section = (title, names, open) => (open
      ? h("section", { class: "card" }, h("div", { class: "card-head" }, h("h2", null, title)), h("div", { class: "pad" }, group(names.map((n) => `spec.${n}`))))
      : h("details", { class: "card" }, h("summary", null, title), h("div", { class: "pad" }, group(names.map((n) => `spec.${n}`)))));
    this.judge = h("input", { type: "checkbox", checked: true, id: "judge", onchange: () => { this.judgeFields.disabled = !this.judge.checked; this.changed(); } });
    this.judgeFields = h("fieldset", null, h("legend", { class: "sr" }, "Evaluation"), group(Object.keys(judging).filter((n) => n !== "task").map((n) => `evaluation.${n}`)));
    const current = this.model?.spec.preset ?? training.preset?.default ?? [...this.presets.keys()][0];
    const radios = [...this.presets].map(([key, preset]) => h("label", { class: "preset" }, h("input", { type: "radio", name: "preset", value: key, checked: key === current, onchange: () => this.setPreset(key) }), h("span", null, h("strong", null, words(key)), h("span", { class: "d" }, preset.summary))));

    this.trouble = h("div");
    this.preview = h("pre", { class: "code", tabindex: 0, "aria-label": "Request body" });
    this.figures = h("dl", { class: "pairs" });
    this.button = h("button", { class: "primary", type: "submit" }, "Submit job");
    const parent = this.params.get("parent");
    fill(this.root, h("form", { onsubmit: (e) => this.submit(e), novalidate: true },
      h("div", { class: "crumbs" }, h("a", { href: "#/" }, "Jobs"), " / New"),
      h("div", { class: "page-head" }, h("h1", { class: "grow" }, "New job")),
      h("div", { class: "form" },
        h("div", { class: "stack" }, this.trouble,
          parent ? notice("info", "Starts from a trained policy:", [h("a", { href: `#/jobs/${parent}` }, this.model.name), this.params.get("checkpoint") ? [", checkpoint ", h("code", null, this.params.get("checkpoint"))] : ", newest checkpoint"]) : null,
          h("fieldset", null, h("legend", { class: "sr" }, "Preset"), h("div", { class: "presets" }, radios)),
          SECTIONS.map(([title, names, open]) => section(title, names.filter((n) => this.fields.has(`spec.${n}`)), open)),
          rest.length ? section("More settings", rest, false) : null,
          h("details", { class: "card" }, h("summary", null, "Evaluation of the final policy"), h("div", { class: "pad stack" }, h("label", { class: "row", for: "judge" }, this.judge, "Evaluate when the training ends"), this.judgeFields)),
          h("section", { class: "card" }, h("div", { class: "card-head" }, h("h2", null, "Name and order")), h("div", { class: "pad" }, group(["name", "tags", "priority", "max_attempts"])))),
        h("aside", { class: "stack" },
          h("section", { class: "card" }, h("div", { class: "card-head" }, h("h2", null, "Summary")), h("div", { class: "pad stack" }, this.figures, this.button)),
          h("details", { class: "card" }, h("summary", null, "Request"), h("div", { class: "pad" }, h("p", { class: "muted", style: { "margin-bottom": "0.6rem" } }, "What the button sends to ", h("code", null, "POST /jobs"), ":"), this.preview))))));
    this.setPreset(current);
    if (this.model) {
      for (const [key, value] of Object.entries(this.model.spec)) if (!(key === "min_height" && value === null)) this.fields.get(`spec.${key}`)?.choose(value);
      if (this.model.evaluation === null) this.judge.checked = false;
      else for (const [key, value] of Object.entries(this.model.evaluation)) this.fields.get(`evaluation.${key}`)?.choose(value);
      if (!parent) {
        this.fields.get("name")?.choose(this.model.name);
        this.fields.get("tags")?.choose(this.model.tags);
      }
      this.changed();
    }
  }

  setPreset(key) {
    this.preset = key;
    const values = this.presets.get(key)?.spec ?? {};
    // Task and robot are the user's choice, not the preset's.
    for (const [path, f] of this.fields) if (path.startsWith("spec.") && f.spec.name in values && !["task", "robot_type", "min_height"].includes(f.spec.name)) f.setBase(values[f.spec.name]);
    this.changed();
  }

  /** The request as it stands; throws the first field's error, after marking all of them when `mark`. */
  body(mark) {
    const spec = { preset: this.preset }, evaluation = {}, out = {};
    let several = null, failed = null;
    for (const [path, f] of this.fields) {
      if (path.startsWith("evaluation.") && !this.judge.checked) continue;
      let value;
      try {
        value = f.value();
        if (mark) f.fail("");
      } catch (error) {
        if (mark) f.fail(error.message);
        failed ??= f;
        continue;
      }
      const name = path.split(".").at(-1);
      if (path === "spec.seed" && Array.isArray(value)) several = value;
      else if (path.startsWith("spec.")) { if (f.touched || ["task", "robot_type", "total_steps", "seed", "simulator"].includes(name)) spec[name] = value; }
      else if (path.startsWith("evaluation.")) { if (f.touched) evaluation[name] = value; }
      else if (f.touched && value !== "" && value !== null) out[name] = value;
    }
    if (failed) throw Object.assign(new Error("Some fields need another look."), { field: failed });
    const parent = this.params.get("parent"), checkpoint = this.params.get("checkpoint");
    const job = { ...out, spec, ...(this.judge.checked ? (Object.keys(evaluation).length ? { evaluation } : {}) : { evaluation: null }), ...(parent ? { parent_job_id: parent } : {}), ...(checkpoint ? { parent_checkpoint_id: checkpoint } : {}) };
    return several ? { group: { job, seeds: several } } : { job };
  }

  changed() {
    if (!this.preview) return;
    const value = (name) => this.fields.get(`spec.${name}`)?.peek();
    const task = this.tasks.get(value("task"));
    if (task) setText(this.fields.get("spec.task").element.querySelector(".hint"), `${task.summary} A torso below ${task.min_height_m} m counts as a fall.`);
    const rollout = value("n_envs") * value("n_steps"), total = value("total_steps"), seed = value("seed");
    const updates = Math.ceil(total / rollout);
    const jobs = Array.isArray(seed) ? seed.length : 1;
    const departs = [...this.fields].filter(([p, f]) => p.startsWith("spec.") && f.touched && !["task", "robot_type", "seed", "total_steps", "simulator"].includes(f.spec.name)).map(([, f]) => f.spec.label);
    const pairs = [["Task", `${value("task")}, type ${value("robot_type")}`], ["Preset", words(this.preset)], ["Steps", Number.isFinite(total) ? compact(total) : "–"], ["Updates", Number.isFinite(updates) ? `${integer(updates)} of ${integer(rollout)} steps` : "–"],
      ["Checkpoints", Number.isFinite(total) && value("checkpoint_interval_steps") ? `about ${integer(Math.max(1, Math.ceil(total / Math.max(value("checkpoint_interval_steps"), rollout))))}` : "–"], ["Jobs", integer(jobs)]];
    fill(this.figures, pairs.map(([k, v]) => [h("dt", null, k), h("dd", null, v)]), departs.length ? [h("dt", null, "Changed"), h("dd", null, departs.join(", "))] : null);
    this.button.textContent = jobs > 1 ? `Submit ${jobs} jobs` : "Submit job";
    try {
      const request = this.body(false);
      this.preview.textContent = JSON.stringify(request.group ?? request.job, null, 2);
    } catch (error) { this.preview.textContent = error.message; }
  }

  async submit(event) {
    event.preventDefault();
    fill(this.trouble);
    let request;
    try {
      request = this.body(true);
    } catch (error) {
      this.reveal(error.field);
      return;
    }
    this.button.disabled = true;
    try {
      if (request.group) {
        const group = await call("groups", { method: "POST", body: request.group, headers: { "Idempotency-Key": this.key } });
        toast(`${group.jobs.length} jobs submitted.`);
        this.go(`/compare?group=${group.id}`);
      } else {
        const job = await call("jobs", { method: "POST", body: request.job, headers: { "Idempotency-Key": this.key } });
        toast(`${job.name} submitted.`);
        this.go(`/jobs/${job.id}`);
      }
    } catch (error) {
      this.key = crypto.randomUUID?.() ?? String(Math.random());
      this.refused(error);
    } finally {
      this.button.disabled = false;
    }
  }

  /** Put each message of the service at its field; what fits none goes on top. */
  refused(error) {
    const left = [];
    let first = null;
    for (const [path, message] of error.fields ?? []) {
      const clean = path.replace(/^(body|job)\./, "").replace(/^job\./, "");
      const named = /(?:^|, )(?:Value error, )?([a-z_]+): (.+)$/s.exec(message);
      const f = this.fields.get(clean) ?? this.fields.get(`spec.${clean}`) ?? (named ? this.fields.get(`spec.${named[1]}`) ?? this.fields.get(`evaluation.${named[1]}`) ?? this.fields.get(named[1]) : undefined);
      if (f) {
        f.fail(message.replace(/^Value error, /, ""));
        first ??= f;
      } else left.push(`${clean}: ${message}`);
    }
    fill(this.trouble, notice("error", "The service refused this job.", left.length ? left.join(" ") : first ? "See the marked fields." : error.message));
    if (first) this.reveal(first);
    else this.trouble.scrollIntoView({ block: "center" });
  }

  reveal(f) {
    const details = f.element.closest("details");
    if (details) details.open = true;
    f.control.focus();
    f.element.scrollIntoView({ block: "center" });
  }
}

/** Show the page in `root`. */
export async function mount(root, context) {
  const view = new SubmitView(root, context);
  await view.start();
  return {};
}
