/** The part of the form of a study that no job has: what to vary, what to optimize, how many trials. */

import { fill, h, icon } from "../dom.js";
import { number } from "../schema.js";
import { Field } from "./field.js";

const RANGE = /^\s*(\S+?)\s*\.\.\s*(\S+?)\s*(:log)?\s*$/;
const WORDS = new Map([
  ["true", true],
  ["false", false],
  ["null", null],
]);
const typed = (text) => (WORDS.has(text) ? WORDS.get(text) : Number.isNaN(number(text)) ? text : number(text));

/**
 * Read the values of a setting as `naoctl tune --space` writes them: LOW..HIGH, with :log for a logarithmic scale, or
 * A|B|C. Throws an error that says what is expected.
 */
function searched(text, integer) {
  const range = RANGE.exec(text);
  if (range) {
    const [low, high] = [number(range[1]), number(range[2])];
    if (Number.isNaN(low) || Number.isNaN(high) || low >= high)
      throw new Error("Write a lower and a higher number: 1e-4..1e-2");
    return { type: integer ? "int" : "float", low, high, log: Boolean(range[3]) };
  }
  const choices = text
    .split("|")
    .map((part) => part.trim())
    .filter(Boolean);
  if (choices.length < 2) throw new Error("Write LOW..HIGH, LOW..HIGH:log, or values as A|B|C.");
  return {
    type: "choice",
    choices: choices.map((part) => (part.includes(",") ? part.split(",").map(typed) : typed(part))),
  };
}

const whole = (name, label, hint, fallback, low, high) => ({
  name,
  label,
  hint,
  fallback,
  unit: null,
  nullable: false,
  kind: "integer",
  low,
  high,
});
const choice = (name, label, hint, choices) => ({
  name,
  label,
  hint,
  choices,
  fallback: choices[0],
  unit: null,
  nullable: false,
  kind: "choice",
});

export class StudyForm {
  /** @param {object} form the form of the job that all trials have in common */
  constructor(form) {
    this.form = form;
    const make = (spec) => new Field(spec, `search.${spec.name}`, () => form.changed());
    this.fields = [
      make(whole("trials", "Trials", "Jobs in all.", 20, 1, 1000)),
      make(whole("parallel", "At a time", "Trials that may wait or run at a time.", 2, 1, 64)),
      make(
        choice("sampler", "Sampler", "How settings are chosen: by the results so far, or at random.", [
          "tpe",
          "random",
        ]),
      ),
    ];
    this.rows = [];
    this.list = h("div", { class: "stack", "data-part": "space" });
    this.objectiveBox = h("div");
    const add = h(
      "button",
      { type: "button", class: "small", onclick: () => this.add() },
      icon("plus"),
      "Vary another setting",
    );
    this.element = h(
      "div",
      { class: "stack" },
      this.list,
      h("div", { class: "row" }, add),
      h(
        "div",
        { class: "fields" },
        this.objectiveBox,
        this.fields.map((f) => f.element),
      ),
    );
  }

  /** Settings of the job that can be varied: all but names and lists of stages. */
  settings() {
    return [...this.form.fields]
      .filter(([path, f]) => path.startsWith("spec.") && !path.startsWith("spec.runtime.") && f.spec.name !== "name")
      .filter(([path]) => path !== "spec.stages")
      .map(([path, f]) => [path.slice("spec.".length), f.spec]);
  }

  add(setting = "algorithm.learning_rate") {
    const name = h("select", { "aria-label": "Setting to vary", onchange: () => this.form.changed() });
    const values = h("input", {
      type: "text",
      "aria-label": "Values of the setting",
      placeholder: "1e-4..1e-2:log or 5|10",
      spellcheck: "false",
      autocomplete: "off",
      oninput: () => this.form.changed(),
    });
    const trouble = h("p", { class: "problem", role: "alert" });
    const remove = h(
      "button",
      {
        type: "button",
        class: "ghost square",
        "aria-label": "Do not vary this setting",
        onclick: () => this.drop(row),
      },
      icon("close"),
    );
    const element = h("div", { class: "field" }, h("div", { class: "row" }, name, values, remove), trouble);
    const row = { name, values, trouble, element, control: values, wanted: setting };
    row.fail = (message) => {
      trouble.textContent = message;
    };
    this.rows.push(row);
    this.list.append(element);
    this.update();
  }

  drop(row) {
    this.rows = this.rows.filter((other) => other !== row);
    row.element.remove();
    this.form.changed();
  }

  /** Offer the settings and the results of the task, robot and algorithm that are chosen now. */
  update() {
    if (!this.rows.length) {
      this.add();
      return;
    }
    const settings = this.settings();
    for (const row of this.rows) {
      const value = row.name.value || row.wanted;
      fill(
        row.name,
        settings.map(([path, spec]) => h("option", { value: path }, `${spec.label} (${path})`)),
      );
      row.name.value = settings.some(([path]) => path === value) ? value : settings[0]?.[0];
    }
    this.offerObjectives();
  }

  offerObjectives() {
    const { known } = this.form;
    const task = known.task(this.form.peek("spec.task.name"));
    const results = known.ofRobot(this.form.peek("spec.robot.name"), [
      ...(task?.results ?? []),
      ...(task?.metrics ?? []),
    ]);
    const names = results.filter((metric) => metric.better).map((metric) => metric.name);
    const main = (task?.headline ?? []).filter((name) => names.includes(name));
    const choices = [...new Set([...main, ...names])];
    if (!choices.length || choices.join() === this.objective?.spec.choices.join()) return;
    const hint = "Result to optimize, in its better direction.";
    const chosen = this.objective?.peek();
    this.objective = new Field(choice("objective", "Objective", hint, choices), "search.objective", () =>
      this.form.changed(),
    );
    if (choices.includes(chosen)) this.objective.choose(chosen);
    fill(this.objectiveBox, this.objective.element);
  }

  trials() {
    return this.fields[0].peek();
  }

  /** The search of the request; throws an error with the field that is wrong, which is marked if `mark`. */
  search(mark) {
    const space = {};
    for (const row of this.rows) {
      const spec = new Map(this.settings()).get(row.name.value);
      try {
        if (row.name.value in space) throw new Error("This setting is varied already.");
        space[row.name.value] = searched(row.values.value, spec?.kind === "integer");
        if (mark) row.fail("");
      } catch (error) {
        if (mark) row.fail(error.message);
        throw Object.assign(error, { field: row });
      }
    }
    const values = Object.fromEntries(this.fields.map((f) => [f.spec.name, this.read(f, mark)]));
    return { space, ...values, ...(this.objective ? { objectives: [{ metric: this.objective.value() }] } : {}) };
  }

  read(f, mark) {
    try {
      return f.value();
    } catch (error) {
      if (mark) f.fail(error.message);
      throw Object.assign(error, { field: f });
    }
  }

  /** The field of a path of the request; null if it is none of these. */
  fieldOf(path) {
    const setting = path.replace(/^search\.space\./, "");
    return (
      this.rows.find((row) => setting === row.name.value || setting.startsWith(`${row.name.value}.`)) ??
      this.fields.find((f) => path === f.path) ??
      (path.startsWith("search.objectives") ? this.objective : null) ??
      null
    );
  }
}
