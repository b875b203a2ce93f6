/** Form that submits a job, made from the service's JSON schema, presets and recipes. No plug-in is named here. */

import { call, submission } from "../api.js";
import { descriptions } from "../descriptions.js";
import { fill, h, setText, toast } from "../dom.js";
import { compact, integer, words } from "../format.js";
import { read, write } from "../kept.js";
import { choices, field, provided, resolve, seeds, variant } from "../schema.js";
import { Field } from "./field.js";
import { loading, notice } from "./messages.js";
import { presetValues } from "./spec-list.js";
import { StudyForm } from "./study-form.js";

/** Sections that a plug-in defines, in the form's order; whether each is open at first. */
const SECTIONS = [
  ["task", true],
  ["robot", true],
  ["simulator", false],
  ["algorithm", false],
];
/**
 * Fields of a section that are no fields of the form: the name has a control of its own, the preset has the cards, the
 * version is the installed one.
 */
const LEFT_OUT = new Set(["name", "preset", "version"]);
/** Fields that a request always contains. */
const ALWAYS = new Set(["spec.task.name", "spec.robot.name", "spec.simulator.name", "spec.total_steps", "spec.seed"]);

const LEVEL_KEY = "naosprint.form";

class SubmitView {
  constructor(root, { params, signal, go }) {
    this.root = root;
    this.params = params;
    this.signal = signal;
    this.go = go;
    this.fields = new Map();
    /** What a study varies and optimizes; null in the form of a job. */
    this.study = params.has("study") ? new StudyForm(this) : null;
    this.title = this.study ? "New study" : "New job";
    this.send = submission();
  }

  async start() {
    document.title = `${this.title} · naosprint`;
    fill(this.root, h("div", { class: "card" }, loading("Loading the form")));
    const parent = this.params.get("parent");
    const from = this.params.get("from") ?? parent;
    const get = (path) => call(path, { signal: this.signal });
    const [schema, presets, recipes, robots, known, model] = await Promise.all([
      get("spec/schema"),
      get("presets"),
      get(parent ? `recipes?start=${encodeURIComponent(parent)}` : "recipes"),
      get("robots"),
      descriptions(),
      from ? get(`jobs/${encodeURIComponent(from)}`) : null,
    ]);
    this.schema = schema;
    this.presets = new Map(presets.map((p) => [p.name, p]));
    this.recipes = new Map(recipes.map((r) => [r.name, r]));
    this.families = new Map(robots.map((r) => [r.name, r.family]));
    this.known = known;
    this.model = model;
    const again = this.params.has("from");
    // What is submitted again starts from the same policy: by its name, where it was named.
    this.parentPolicy = again ? model.parent_policy : null;
    this.parent = again
      ? { job: model.parent_job_id, checkpoint: model.parent_checkpoint_id }
      : { job: this.params.get("parent"), checkpoint: this.params.get("checkpoint") };
    if (this.parentPolicy) this.parent = {};
    this.parentGone = again && model.needs_policy && !this.parentPolicy && !this.parent.job;
    this.build();
  }

  /** Make a field of the form; `change` is called, too, when the user changes it. */
  make(path, spec, change = () => {}) {
    const f = new Field(spec, path, () => {
      change();
      this.changed();
    });
    this.fields.set(path, f);
    return f;
  }

  peek(path) {
    return this.fields.get(path)?.peek();
  }

  build() {
    const { schema } = this;
    const job = resolve(schema, schema).properties;
    this.training = resolve(job.spec, schema).properties;
    const evaluation = resolve(
      (job.evaluation.anyOf ?? [job.evaluation]).find((o) => o.type !== "null"),
      schema,
    ).properties;
    const make = (properties, prefix, names) =>
      names.filter((n) => properties[n]).map((n) => this.make(`${prefix}${n}`, field(n, properties[n], schema)));
    const grid = (fields) =>
      h(
        "div",
        { class: "fields" },
        fields.map((f) => f.element),
      );
    const card = (title, content, open = true) =>
      open
        ? h(
            "section",
            { class: "card" },
            h("div", { class: "card-head" }, h("h2", null, title)),
            h("div", { class: "pad" }, content),
          )
        : h("details", { class: "card advanced" }, h("summary", null, title), h("div", { class: "pad" }, content));

    const steps = grid(
      make(
        this.training,
        "spec.",
        Object.keys(this.training).filter((n) => n !== "runtime" && !SECTIONS.some(([section]) => section === n)),
      ),
    );
    const runtime = resolve(this.training.runtime, schema).properties;
    const speed = grid(make(runtime, "spec.runtime.", Object.keys(runtime)));
    const order = grid(make(job, "", ["name", "tags", "priority", "max_attempts"]));
    this.evaluate = h("input", {
      type: "checkbox",
      checked: true,
      id: "evaluate",
      onchange: () => {
        this.evaluationFields.disabled = !this.evaluate.checked;
        this.changed();
      },
    });
    this.evaluationFields = h(
      "fieldset",
      null,
      h("legend", { class: "sr" }, "Evaluation"),
      grid(
        make(
          evaluation,
          "evaluation.",
          Object.keys(evaluation).filter((n) => n !== "task"),
        ),
      ),
    );
    const seed = this.fields.get("spec.seed");
    seed.spec = {
      ...seed.spec,
      hint: `${seed.spec.hint} Several, as 0, 1, 2 or 0-4, make a group of jobs.`,
      read: (text) => {
        const all = seeds(text);
        return all.length === 1 ? all[0] : all;
      },
    };
    seed.element.querySelector(".hint").textContent = seed.spec.hint;
    const tags = this.fields.get("tags");
    tags.spec = { ...tags.spec, kind: "list", read: (text) => text.split(/[\s,]+/).filter(Boolean) };
    this.fields.get("name").control.placeholder = "default: task, preset and seed";
    this.sections = new Map(SECTIONS.map(([name]) => [name, h("div", { class: "fields" })]));

    const current = this.model?.spec.algorithm?.preset ?? [...this.presets.keys()][0];
    const radios = [...this.presets].map(([key, preset]) =>
      h(
        "label",
        { class: "preset" },
        h("input", {
          type: "radio",
          name: "preset",
          value: key,
          checked: key === current,
          onchange: () => this.setPreset(key),
        }),
        h("span", null, h("strong", null, words(key)), h("span", { class: "d" }, preset.summary)),
      ),
    );
    const recipe = h(
      "select",
      {
        id: "recipe",
        onchange: () => {
          const job = this.recipes.get(recipe.value)?.job ?? { spec: {} };
          this.parentPolicy = job.parent_policy;
          if (this.params.has("from")) this.parent = {};
          this.parentGone = false;
          this.paintOrigin();
          this.fillFrom(job);
        },
      },
      h("option", { value: "" }, "None"),
      [...this.recipes.values()].map((r) => h("option", { value: r.name }, `${r.name}: ${r.summary}`)),
    );
    const titleOf = (name) => resolve(this.training[name], schema).title ?? words(name);

    this.levels = ["basic", "advanced"].map((level) =>
      h("button", { type: "button", "data-level": level, onclick: () => this.setLevel(level) }, words(level)),
    );
    this.trouble = h("div");
    this.preview = h("pre", { class: "code", tabindex: 0, "aria-label": "Request body" });
    this.overview = h("dl", { class: "pairs" });
    this.button = h("button", { class: "primary", type: "submit" }, "Submit job");
    this.origin = h("div");
    this.paintOrigin();
    const sectionCard = (name) => card(titleOf(name), this.sections.get(name), SECTIONS.find(([n]) => n === name)[1]);
    fill(
      this.root,
      h(
        "form",
        { onsubmit: (e) => this.submit(e), novalidate: true },
        h(
          "div",
          { class: "crumbs" },
          this.study ? h("a", { href: "#/studies" }, "Studies") : h("a", { href: "#/" }, "Jobs"),
          " / New",
        ),
        h(
          "div",
          { class: "page-head" },
          h("h1", { class: "grow" }, this.title),
          h("div", { class: "segments", role: "group", "aria-label": "Settings to show" }, this.levels),
        ),
        h(
          "div",
          { class: "form" },
          h(
            "div",
            { class: "stack" },
            this.trouble,
            this.origin,
            this.recipes.size
              ? h(
                  "div",
                  { class: "field" },
                  h("label", { for: "recipe" }, h("span", { class: "t" }, "Recipe")),
                  recipe,
                  h(
                    "p",
                    { class: "hint" },
                    "Fills the form with a job that is known to work",
                    this.params.has("parent") ? ", without the stages before the policy that it starts from." : ".",
                  ),
                )
              : null,
            h("fieldset", null, h("legend", { class: "sr" }, "Preset"), h("div", { class: "presets" }, radios)),
            sectionCard("task"),
            sectionCard("robot"),
            card("Length", steps),
            this.study ? card("Search", this.study.element) : null,
            sectionCard("simulator"),
            sectionCard("algorithm"),
            card(this.training.runtime.title ?? "Runtime", speed, false),
            h(
              "details",
              { class: "card advanced" },
              h("summary", null, "Evaluation of the final policy"),
              h(
                "div",
                { class: "pad stack" },
                h("label", { class: "row", for: "evaluate" }, this.evaluate, "Evaluate when the training ends"),
                this.evaluationFields,
              ),
            ),
            card("Name and order", order),
          ),
          h(
            "aside",
            { class: "stack" },
            h(
              "section",
              { class: "card" },
              h("div", { class: "card-head" }, h("h2", null, "Summary")),
              h("div", { class: "pad stack" }, this.overview, this.button),
            ),
            h(
              "details",
              { class: "card" },
              h("summary", null, "Request"),
              h(
                "div",
                { class: "pad" },
                h(
                  "p",
                  { class: "muted", style: { "margin-bottom": "0.6rem" } },
                  "What the button sends to ",
                  h("code", null, this.study ? "POST /studies" : "POST /jobs"),
                  ":",
                ),
                this.preview,
              ),
            ),
          ),
        ),
      ),
    );
    this.setLevel(read(LEVEL_KEY) ?? "basic");
    this.preset = current;
    for (const [name] of SECTIONS) this.buildSection(name, {});
    this.setPreset(current);
    if (this.model)
      this.fillFrom(
        this.params.has("parent") ? { spec: this.model.spec, evaluation: this.model.evaluation } : this.model,
      );
  }

  /** Show which policy the training starts from. */
  paintOrigin() {
    const { job, checkpoint } = this.parent;
    const source = job
      ? [
          h("a", { href: `#/jobs/${job}` }, this.params.has("parent") ? this.model.name : job),
          checkpoint ? [", checkpoint ", h("code", null, checkpoint)] : ", newest checkpoint",
        ]
      : this.parentPolicy && h("code", null, this.parentPolicy);
    const gone = "The policy that this job started from has been deleted:";
    fill(
      this.origin,
      source ? notice("info", "Starts from a trained policy:", source) : null,
      this.parentGone ? notice("warn", gone, "it would start from random weights.") : null,
    );
    this.origin.hidden = !source && !this.parentGone;
  }

  /**
   * Make the fields of a section for the plug-in `values.name` or the default, with `values` in place of the defaults.
   */
  buildSection(name, values) {
    const section = resolve(this.training[name], this.schema);
    const robot = name === "robot" ? null : this.peek("spec.robot.name");
    const names = choices(section, robot);
    const wanted = values.name ?? this.peek(`spec.${name}.name`) ?? section.default?.name;
    const chosen = names.includes(wanted) ? wanted : names[0];
    for (const path of [...this.fields.keys()]) if (path.startsWith(`spec.${name}.`)) this.fields.delete(path);
    const control = this.make(
      `spec.${name}.name`,
      {
        name: "name",
        label: section.title ?? words(name),
        hint: section.description ?? "",
        unit: null,
        nullable: false,
        kind: "choice",
        choices: names,
        fallback: section.default?.name,
      },
      () => this.choosePlugin(name),
    );
    if (names.length === 1) control.control.disabled = true;
    const { properties } = variant(section, chosen, robot, this.schema);
    control.choose(chosen);
    const fields = Object.entries(properties)
      .filter(([n]) => !LEFT_OUT.has(n))
      .map(([n, property]) => this.make(`spec.${name}.${n}`, field(n, property, this.schema)));
    fill(
      this.sections.get(name),
      control.element,
      fields.map((f) => f.element),
    );
    this.setBases(name);
    for (const f of fields) if (f.spec.name in values) f.choose(values[f.spec.name]);
  }

  /** Settings of a section that the user has changed. */
  touched(name) {
    return Object.fromEntries(
      [...this.fields]
        .filter(
          ([path, f]) =>
            path.startsWith(`spec.${name}.`) && f.touched && f.spec.name !== "name" && f.peek() !== undefined,
        )
        .map(([, f]) => [f.spec.name, f.peek()]),
    );
  }

  /** Hide settings that need what the chosen robot, simulator and task lack. */
  restrict() {
    const robot = this.peek("spec.robot.name");
    const there = new Set(
      SECTIONS.flatMap(([name]) => provided(this.training[name], this.peek(`spec.${name}.name`), robot, this.schema)),
    );
    for (const f of this.fields.values())
      if (f.spec.provides && (f.peek() ?? null) !== (f.spec.fallback ?? null)) there.add(f.spec.provides);
    for (const f of this.fields.values()) if (f.spec.needs) f.allow(there.has(f.spec.needs));
  }

  /** Another plug-in has other settings; another robot, other simulators and tasks as well. */
  choosePlugin(name) {
    this.buildSection(name, { ...this.touched(name), name: this.peek(`spec.${name}.name`) });
    if (name === "robot") {
      for (const other of ["simulator", "task"]) this.buildSection(other, this.touched(other));
      for (const [section] of SECTIONS) this.setBases(section);
    }
    this.fields.get(`spec.${name}.name`).control.focus();
  }

  /** Set the values of a section's fields that apply until the user changes them: the preset's, else the defaults. */
  setBases(name) {
    const values = presetValues(this.presets.get(this.preset), this.families.get(this.peek("spec.robot.name")));
    for (const [path, f] of this.fields)
      if (path.startsWith(`spec.${name}.`) && f.spec.name !== "name")
        f.setBase((f.spec.own ? null : values[path.slice("spec.".length)]) ?? f.spec.fallback);
  }

  /** Show the fields that most jobs need, or all. */
  setLevel(level) {
    write(LEVEL_KEY, level);
    this.root.querySelector("form").classList.toggle("basic", level === "basic");
    for (const button of this.levels) button.setAttribute("aria-pressed", String(button.dataset.level === level));
  }

  setPreset(key) {
    this.preset = key;
    for (const [name] of SECTIONS) this.setBases(name);
    this.changed();
  }

  /** Fill the form from a job or a recipe. */
  fillFrom({ spec, evaluation, ...order }) {
    this.preset = spec.algorithm?.preset ?? [...this.presets.keys()][0];
    for (const radio of this.root.querySelectorAll("input[name=preset]")) radio.checked = radio.value === this.preset;
    for (const section of ["robot", "task", "simulator", "algorithm"])
      this.buildSection(section, typeof spec[section] === "string" ? { name: spec[section] } : (spec[section] ?? {}));
    for (const [path, f] of this.fields) {
      const [root, first, second] = path.split(".");
      if (root !== "spec" || SECTIONS.some(([section]) => section === first)) continue;
      const value = second ? spec[first]?.[second] : spec[first];
      f.choose(value ?? f.spec.fallback);
    }
    this.evaluate.checked = evaluation !== null;
    this.evaluationTask = evaluation?.task;
    this.evaluationFields.disabled = evaluation === null;
    for (const [path, f] of this.fields) {
      const [root, key] = path.split(".");
      if (root === "evaluation") f.choose(evaluation?.[key] ?? f.spec.fallback);
      else if (order[root] !== undefined) f.choose(order[root]);
    }
    this.changed();
  }

  /** Return the path and the body of the request; throws the first field's error, with all of them marked if `mark`. */
  body(mark) {
    const spec = { algorithm: { preset: this.preset } };
    const evaluation = {};
    const out = {};
    let several = null;
    let failed = null;
    for (const [path, f] of this.fields) {
      if (path.startsWith("evaluation.") && !this.evaluate.checked) continue;
      let value;
      try {
        value = f.value();
        if (mark) f.fail("");
      } catch (error) {
        if (mark) f.fail(error.message);
        failed ??= f;
        continue;
      }
      const [root, first, second] = path.split(".");
      if (path === "spec.seed" && Array.isArray(value)) several = value;
      else if (root === "spec") {
        if (!f.touched && !ALWAYS.has(path)) continue;
        if (second) {
          spec[first] ??= {};
          spec[first][second] = value;
        } else spec[first] = value;
      } else if (root === "evaluation") {
        if (f.touched) evaluation[first] = value;
      } else if (f.touched && value !== "" && value !== null) out[root] = value;
    }
    if (failed) throw Object.assign(new Error("Some fields are not valid."), { field: failed });
    if (this.evaluationTask) evaluation.task = this.evaluationTask; // it has no field
    if (spec.stages?.length) delete spec.total_steps; // their sum
    const { job: parent, checkpoint } = this.parent;
    const job = {
      ...out,
      spec,
      ...(this.evaluate.checked ? (Object.keys(evaluation).length ? { evaluation } : {}) : { evaluation: null }),
      ...(parent ? { parent_job_id: parent } : {}),
      ...(checkpoint ? { parent_checkpoint_id: checkpoint } : {}),
      ...(this.parentPolicy && !parent ? { parent_policy: this.parentPolicy } : {}),
    };
    if (!this.study) return several ? ["groups", { job, seeds: several }] : ["jobs", job];
    if (several)
      throw Object.assign(new Error("A study varies settings; give one seed."), {
        field: this.fields.get("spec.seed"),
      });
    const { name, ...common } = job;
    return ["studies", { job: common, search: this.study.search(mark), ...(name ? { name } : {}) }];
  }

  changed() {
    if (!this.preview) return;
    this.restrict();
    const value = (name) => this.peek(`spec.${name}`);
    const task = this.known.task(value("task.name"));
    if (task) setText(this.fields.get("spec.task.name").element.querySelector(".hint"), task.summary);
    const stages = value("stages");
    const staged = Array.isArray(stages) && stages.length;
    const total = staged ? stages.reduce((sum, { steps = NaN }) => sum + steps, 0) : value("total_steps");
    const rollout = value("algorithm.n_envs") * value("algorithm.n_steps");
    const interval = value("runtime.checkpoint_interval_steps");
    const seed = value("seed");
    const updates = Math.ceil(total / rollout);
    const jobs = Array.isArray(seed) ? seed.length : 1;
    const changed = [...this.fields]
      .filter(
        ([path, f]) => path.startsWith("spec.") && f.touched && !ALWAYS.has(path) && path !== "spec.algorithm.name",
      )
      .map(([, f]) => f.spec.label);
    const pairs = [
      ["Task", `${value("task.name")}, ${value("robot.name")}`],
      ["Preset", words(this.preset)],
      ["Steps", Number.isFinite(total) ? `${compact(total)}${staged ? ` in ${stages.length} stages` : ""}` : "–"],
      ["Updates", Number.isFinite(updates) ? `${integer(updates)} of ${integer(rollout)} steps` : "–"],
      [
        "Checkpoints",
        Number.isFinite(total) && interval
          ? `about ${integer(Math.max(1, Math.ceil(total / Math.max(interval, rollout || 1))))}`
          : "–",
      ],
      this.study ? ["Trials", integer(this.study.trials())] : ["Jobs", integer(jobs)],
    ];
    fill(
      this.overview,
      pairs.map(([k, v]) => [h("dt", null, k), h("dd", null, v)]),
      changed.length ? [h("dt", null, "Changed"), h("dd", null, changed.join(", "))] : null,
    );
    this.button.textContent = this.study ? "Start study" : jobs > 1 ? `Submit ${jobs} jobs` : "Submit job";
    this.study?.update();
    try {
      this.preview.textContent = JSON.stringify(this.body(false)[1], null, 2);
    } catch (error) {
      this.preview.textContent = error.message;
    }
  }

  async submit(event) {
    event.preventDefault();
    fill(this.trouble);
    let path;
    let body;
    try {
      [path, body] = this.body(true);
    } catch (error) {
      this.reveal(error.field);
      return;
    }
    this.button.disabled = true;
    try {
      const made = await this.send(path, body);
      toast(
        path === "groups"
          ? `${made.jobs.length} jobs submitted.`
          : `${made.name} ${this.study ? "started" : "submitted"}.`,
      );
      this.go(path === "groups" ? `/compare?group=${made.id}` : `/${path}/${made.id}`);
    } catch (error) {
      this.refused(error);
    } finally {
      this.button.disabled = false;
    }
  }

  /** Show each message of the service at its field, and those that belong to no field at the top. */
  refused(error) {
    const left = [];
    let first = null;
    for (const [path, message] of error.fields ?? []) {
      const clean = path.replace(/^(body|job)\./, "").replace(/^job\./, "");
      const f = this.study?.fieldOf(clean) ?? this.fieldOf(clean);
      if (f) {
        f.fail(message);
        first ??= f;
      } else left.push(`${clean}: ${message}`);
    }
    fill(
      this.trouble,
      notice(
        "error",
        `The service refused this ${this.study ? "study" : "job"}.`,
        left.length ? left.join(" ") : first ? "See the marked fields." : error.message,
      ),
    );
    if (first) this.reveal(first);
    else this.trouble.scrollIntoView({ block: "center" });
  }

  /** The field at a path, or the one that it is a part of: an item's list, a section's name. */
  fieldOf(path) {
    for (let parts = path.split("."); parts.length; parts.pop()) {
      const f = this.fields.get(parts.join(".")) ?? this.fields.get(`${parts.join(".")}.name`);
      if (f) return f;
    }
    return null;
  }

  reveal(f) {
    if (f.element.closest(".advanced")) this.setLevel("advanced");
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
