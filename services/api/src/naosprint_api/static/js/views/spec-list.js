/** Specification by section, with the names of the form; overrides of its preset are marked. */

import { call } from "../api.js";
import { h } from "../dom.js";
import { words } from "../format.js";
import { field, resolve, variant } from "../schema.js";

/** Sections that a preset sets. */
const PRESET_SECTIONS = ["algorithm", "task"];

/** A setting's value as text. */
export const show = (v) =>
  v === null
    ? "none"
    : Array.isArray(v)
      ? !v.length
        ? "none"
        : v.every((x) => typeof x !== "object")
          ? v.join(" × ")
          : JSON.stringify(v)
      : typeof v === "object"
        ? JSON.stringify(v)
        : typeof v === "boolean"
          ? v
            ? "yes"
            : "no"
          : typeof v === "number" && Math.abs(v) >= 1e4
            ? v.toLocaleString("en-US")
            : String(v);

/** A specification by path with dots: {"algorithm.learning_rate": 0.0005}; lists stay whole. */
export function flattened(value, path = "") {
  if (value === null || typeof value !== "object" || Array.isArray(value)) return { [path]: value };
  return Object.assign(
    {},
    ...Object.entries(value).map(([key, inner]) => flattened(inner, path ? `${path}.${key}` : key)),
  );
}

/** Names, units and hints of settings by path, and the presets, from the service's schema. */
export async function knowledge(signal) {
  const [schema, presets, robots] = await Promise.all([
    call("spec/schema", { signal }),
    call("presets", { signal }),
    call("robots", { signal }),
  ]);
  const { spec, evaluation } = resolve(schema, schema).properties;
  const sections = resolve(spec, schema).properties;
  const fieldsOf = (properties, prefix = "") =>
    Object.entries(properties).map(([name, property]) => [`${prefix}${name}`, field(name, property, schema)]);
  /** Settings of one specification: those of its plug-ins. */
  const training = (values) =>
    new Map(
      Object.entries(sections).flatMap(([name, section]) => {
        const chosen = variant(section, values[name]?.name, values.robot?.name, schema);
        return chosen
          ? fieldsOf(chosen.properties, `${name}.`).map(([path, f]) =>
              path === `${name}.name`
                ? [path, { ...f, label: resolve(section, schema).title ?? words(name) }]
                : [path, f],
            )
          : [[name, field(name, section, schema)]];
      }),
    );
  const evaluated = resolve(evaluation.anyOf?.find((o) => o.type !== "null") ?? evaluation, schema);
  return {
    training,
    evaluation: new Map(fieldsOf(evaluated.properties)),
    presets,
    families: new Map(robots.map((r) => [r.name, r.family])),
  };
}

/** What a preset sets for the robot of a specification, by path. */
export function presetValues(preset, family) {
  if (!preset) return {};
  const sections = Object.fromEntries(
    PRESET_SECTIONS.map((section) => [section, { ...preset[section], ...preset.robots?.[family]?.[section] }]),
  );
  return flattened(sections);
}

/** Paths of the settings that differ from what the specification's preset sets; `fields` are those of `training`. */
export function overrides(spec, presets, family, fields) {
  const preset = presets.find((p) => p.name === spec.algorithm?.preset);
  const mine = flattened(spec);
  return new Set(
    Object.entries(presetValues(preset, family))
      .filter(
        ([path, value]) =>
          path in mine && !fields.get(path)?.own && JSON.stringify(mine[path]) !== JSON.stringify(value),
      )
      .map(([path]) => path),
  );
}

/**
 * Settings as a list of names and values; `fields` gives order, names, units and hints by path, `changed` those that
 * override the preset.
 */
export function specList(values, fields = new Map(), changed = new Set()) {
  const order = new Map([...fields.keys()].map((path, i) => [path, i]));
  const rank = ([path]) => order.get(path) ?? order.size;
  return h(
    "dl",
    null,
    Object.entries(flattened(values))
      .sort((a, b) => rank(a) - rank(b))
      .map(([path, value]) => {
        const known = fields.get(path);
        return h(
          "div",
          { class: "pair", title: known?.hint },
          h(
            "dt",
            null,
            known?.label ??
              words(
                path
                  .replace(/\.name$/, "")
                  .split(".")
                  .at(-1),
              ),
          ),
          h(
            "dd",
            { class: changed.has(path) ? "changed" : null },
            show(value),
            known?.unit && value !== null ? h("span", { class: "unit" }, known.unit) : null,
            changed.has(path) ? h("span", { class: "sr" }, " (overrides the preset)") : null,
          ),
        );
      }),
  );
}
