/** One field of a form that is made from a schema. */

import { h } from "../dom.js";
import { fromText, toText } from "../schema.js";

/** Fields that the basic form shows; the others keep the values of preset or recipe. */
const BASIC = new Set(["spec.task.name", "spec.robot.name", "spec.total_steps", "spec.seed", "name", "tags"]);
const sameValue = (a, b) => JSON.stringify(a ?? null) === JSON.stringify(b ?? null);

/** One field of the form: its control, what the user changed and what is wrong with it. */
export class Field {
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
    if (spec.kind === "choice")
      this.control = h(
        "select",
        { ...common, onchange: changed },
        spec.choices.map((c, i) => h("option", { value: i }, c === null ? "none" : String(c))),
      );
    else if (spec.kind === "flag") this.control = h("input", { ...common, type: "checkbox", onchange: changed });
    else
      this.control = h("input", {
        ...common,
        type: "text",
        autocomplete: "off",
        spellcheck: "false",
        inputmode: spec.kind === "integer" || spec.kind === "number" ? "decimal" : null,
        placeholder: spec.nullable ? "none" : null,
        oninput: changed,
        onblur: () => this.settle(),
      });
    this.undo = h(
      "button",
      {
        type: "button",
        class: "ghost reset",
        hidden: true,
        "aria-label": `Back to the preset's ${spec.label}`,
        onclick: () => {
          this.touched = false;
          this.set(this.base);
          this.fail("");
          onChange(this);
        },
      },
      "reset",
    );
    const label = h(
      "label",
      { for: id },
      spec.kind === "flag" ? this.control : null,
      h("span", { class: "t" }, spec.label),
      spec.unit ? h("span", { class: "unit" }, spec.unit) : null,
      this.undo,
    );
    this.element = h(
      "div",
      {
        class: [
          "field",
          spec.kind === "flag" && "check",
          !BASIC.has(path) && !path.startsWith("search.") && "advanced",
        ],
        "data-field": path,
      },
      label,
      spec.kind === "flag" ? null : this.control,
      h("p", { class: "hint", id: help }, spec.hint),
      this.trouble,
    );
    this.set(this.base);
  }

  /** Set the value that applies until the user changes it. */
  setBase(value) {
    this.base = value;
    if (!this.touched) this.set(value);
    else {
      this.touched = !sameValue(this.peek(), value);
      this.paint();
    }
  }

  set(value) {
    if (this.spec.kind === "choice")
      this.control.value = String(
        Math.max(
          0,
          this.spec.choices.findIndex((c) => sameValue(c, value)),
        ),
      );
    else if (this.spec.kind === "flag") this.control.checked = Boolean(value);
    else this.control.value = toText(this.spec, value);
    this.paint();
  }

  /** Set as if the user had typed it. */
  choose(value) {
    this.touched = !sameValue(value, this.base);
    this.set(value);
  }

  /** Hide the field, with its default again, where its setting is not possible. */
  allow(possible) {
    this.element.hidden = !possible;
    if (possible || !this.touched) return;
    this.touched = false;
    this.set(this.base);
    this.fail("");
  }

  /** Return the value; throws when the text is none. */
  value() {
    if (this.spec.kind === "choice") return this.spec.choices[Number(this.control.value)];
    if (this.spec.kind === "flag") return this.control.checked;
    return this.spec.read ? this.spec.read(this.control.value) : fromText(this.spec, this.control.value);
  }

  peek() {
    try {
      return this.value();
    } catch {
      return undefined;
    }
  }

  settle() {
    try {
      this.value();
      this.fail("");
    } catch (error) {
      this.fail(error.message);
    }
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
