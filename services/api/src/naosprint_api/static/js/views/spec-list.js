/** A specification, field by field, named as the form names it, with what departs from its preset marked. */

import { call } from "../api.js";
import { h } from "../dom.js";
import { words } from "../format.js";
import { field, resolve } from "../schema.js";

const NOT_PRESET = new Set(["task", "robot_type", "simulator", "seed", "preset", "min_height", "total_steps"]);

/** A field's value as text. */
export const show = (v) => (v === null ? "none" : Array.isArray(v) ? v.join(" × ") : typeof v === "boolean" ? (v ? "yes" : "no") : typeof v === "number" && Math.abs(v) >= 1e4 ? v.toLocaleString("en-US") : String(v));

/** Names, units and hints by field name, of trainings and of evaluations, and the presets, as the service tells them. */
export async function knowledge(signal) {
  const [schema, presets] = await Promise.all([call("spec/schema", { signal }), call("presets", { signal })]);
  const { spec, evaluation } = resolve(schema, schema).properties;
  const fieldsOf = (part) => new Map(Object.entries(resolve(part, schema).properties).map(([name, property]) => [name, field(name, property, schema)]));
  return { training: fieldsOf(spec), judging: fieldsOf(evaluation.anyOf?.find((o) => o.type !== "null") ?? evaluation), presets };
}

/** Names of the fields that depart from the specification's preset. */
export function departures(spec, presets) {
  const base = presets.find((p) => p.name === spec.preset)?.spec ?? {};
  return new Set(Object.keys(base).filter((k) => !NOT_PRESET.has(k) && JSON.stringify(base[k]) !== JSON.stringify(spec[k])));
}

/** Fields as a list of names and values; `fields` gives names, units and hints, `changed` those to mark as departing from the preset. */
export function specList(values, fields = new Map(), changed = new Set()) {
  return h("dl", null, Object.entries(values).map(([key, value]) => {
    const known = fields.get(key);
    return h("div", { class: "pair", title: known?.hint }, h("dt", null, known?.label ?? words(key)), h("dd", { class: changed.has(key) ? "changed" : null }, show(value), known?.unit && value !== null ? h("span", { class: "unit" }, known.unit) : null, changed.has(key) ? h("span", { class: "sr" }, " (departs from the preset)") : null));
  }));
}
