/** Convert a JSON schema to form fields, and form fields to values. Independent of any single field. */

import { words } from "./format.js";

/** Follow $ref and single-entry allOf. */
export function resolve(schema, root) {
  let node = schema;
  for (let i = 0; i < 10 && node; i++) {
    if (node.$ref) {
      const target = node.$ref
        .replace(/^#\//, "")
        .split("/")
        .reduce((at, key) => at?.[key], root);
      const { $ref, ...rest } = node;
      node = { ...target, ...rest };
    } else if (node.allOf?.length === 1) {
      const { allOf, ...rest } = node;
      node = { ...allOf[0], ...rest };
    } else break;
  }
  return node;
}

/**
 * The schema of one plug-in's section: the alternative of that name, for that robot where several differ by robot; null
 * if there is none.
 */
export function variant(section, name, robot, root) {
  const options = resolve(section, root)?.oneOf;
  if (!options) {
    const plainSection = resolve(section, root);
    return plainSection?.properties ? plainSection : null;
  }
  const named = options.filter((o) => o.properties.name.const === name);
  return named.find((o) => !o["x-robots"] || o["x-robots"].includes(robot)) ?? named[0] ?? { properties: {} };
}

/** Names of the plug-ins that a section may choose, those that the robot can use. */
export const choices = (section, robot) => [
  ...new Set(
    section.oneOf
      .filter((o) => !robot || !o["x-robots"] || o["x-robots"].includes(robot))
      .map((o) => o.properties.name.const),
  ),
];

/** What a plug-in provides for settings that need it, see `needs` of a field. */
export const provided = (section, name, robot, root) =>
  variant(section, name, robot, root)?.["x-provides"]?.[robot] ?? [];

/**
 * Describe one property as a field.
 *
 * @returns {{name: string, label: string, hint: string, unit: string|null, own: boolean, needs: string|null, provides:
 *   string|null, kind: "choice"|"flag"|"integer"|"number"|"list"|"json"|"text", nullable: boolean, choices?: any[],
 *   low?: number, high?: number, openLow?: boolean, openHigh?: boolean, fallback: any}}
 */
export function field(name, schema, root) {
  const outer = resolve(schema, root);
  let inner = outer;
  let nullable = false;
  if (outer.anyOf) {
    const options = outer.anyOf.map((o) => resolve(o, root));
    nullable = options.some((o) => o.type === "null");
    const rest = options.filter((o) => o.type !== "null");
    inner =
      rest.length === 1
        ? { ...rest[0], ...Object.fromEntries(Object.entries(outer).filter(([k]) => k !== "anyOf")) }
        : outer;
  }
  const low = inner.minimum ?? inner.exclusiveMinimum;
  const high = inner.maximum ?? inner.exclusiveMaximum;
  // Without a title of its own a field gets one made of its name, with every word in capitals.
  const made = name
    .split("_")
    .map((word) => word.charAt(0).toUpperCase() + word.slice(1))
    .join(" ");
  const given = outer.title && outer.title !== made ? outer.title : null;
  const base = {
    name,
    label: given ?? words(name),
    hint: outer.description ?? "",
    unit: outer.unit ?? null,
    own: outer.own ?? false,
    needs: outer.needs ?? null,
    provides: outer.provides ?? null,
    nullable,
    low,
    high,
    openLow: inner.exclusiveMinimum !== undefined,
    openHigh: inner.exclusiveMaximum !== undefined,
    fallback: outer.default,
  };
  const choices = inner.enum ?? (inner.const !== undefined ? [inner.const] : null);
  if (choices)
    return { ...base, kind: "choice", choices: nullable ? [...choices.filter((c) => c !== null), null] : choices };
  if (inner.type === "boolean") return { ...base, kind: "flag" };
  if (inner.type === "integer" && low !== undefined && high !== undefined && high - low <= 9)
    return { ...base, kind: "choice", choices: Array.from({ length: high - low + 1 }, (_, i) => low + i) };
  if (inner.type === "integer" || inner.type === "number") return { ...base, kind: inner.type };
  if (inner.type === "object" || (inner.type === "array" && inner.items?.type !== "integer"))
    return { ...base, kind: "json" };
  if (inner.type === "array") return { ...base, kind: "list" };
  return { ...base, kind: "text" };
}

const SUFFIX = { k: 1e3, M: 1e6, m: 1e6, G: 1e9 };

/** Read a number as people type it: 10M, 200k, 1e6, 10,000,000, 10_000_000. NaN when it is none. */
export function number(text) {
  const match = /^([+-]?(?:\d[\d,_ ]*)?(?:\.\d*)?(?:e[+-]?\d+)?)\s*([kMmG]?)$/i.exec(text.trim());
  if (!match || !/\d/.test(match[1])) return NaN;
  const value = Number(match[1].replace(/[,_ ]/g, ""));
  const scale = match[2] ? (SUFFIX[match[2]] ?? SUFFIX[match[2].toLowerCase()] ?? 1) : 1;
  return Number((value * scale).toPrecision(15));
}

/** Show a value in its field. */
export function toText(f, value) {
  if (value === null || value === undefined) return "";
  if (f.kind === "json")
    return (Array.isArray(value) ? value.length : Object.keys(value).length) ? JSON.stringify(value) : "";
  if (f.kind === "list") return value.join(", ");
  if (f.kind === "integer" && Math.abs(value) >= 10_000) return value.toLocaleString("en-US");
  return String(value);
}

/** Read a field's text; throws an Error with what is wrong and what is right. */
export function fromText(f, text) {
  const t = text.trim();
  if (f.kind === "list") {
    const values =
      t === ""
        ? []
        : t
            .split(/[\s,;×x]+/)
            .filter(Boolean)
            .map(Number);
    if (values.some((v) => !Number.isInteger(v) || v < 1))
      throw new Error("Whole numbers separated by commas, for example 64, 64");
    return values;
  }
  if (f.kind === "json") {
    if (t === "") return f.nullable ? null : f.fallback;
    try {
      return JSON.parse(t);
    } catch {
      throw new Error(`Not JSON; for example ${Array.isArray(f.fallback) ? '[{"steps": 1000000}]' : '{"name": 1}'}`);
    }
  }
  if (f.kind === "text") return t === "" && f.nullable ? null : t;
  if (t === "") {
    if (f.nullable) return null;
    throw new Error("A number is needed here");
  }
  const value = number(t);
  if (Number.isNaN(value)) throw new Error("Not a number; 250000, 250k and 2.5e5 all work");
  if (f.kind === "integer" && !Number.isInteger(value)) throw new Error("A whole number is needed here");
  if (f.low !== undefined && (f.openLow ? value <= f.low : value < f.low))
    throw new Error(`Must be ${f.openLow ? "more than" : "at least"} ${f.low}`);
  if (f.high !== undefined && (f.openHigh ? value >= f.high : value > f.high))
    throw new Error(`Must be ${f.openHigh ? "less than" : "at most"} ${f.high.toLocaleString("en-US")}`);
  return value;
}

/** Read "0, 1, 2" or "0-4" as a list of seeds. */
export function seeds(text) {
  const out = [];
  for (const part of text.split(/[\s,;]+/).filter(Boolean)) {
    const range = /^(\d+)\s*(?:-|–|\.\.)\s*(\d+)$/.exec(part);
    if (range) {
      const [a, b] = [Number(range[1]), Number(range[2])];
      if (b < a || b - a > 255) throw new Error("A range must be ascending and have at most 256 seeds");
      for (let i = a; i <= b; i++) out.push(i);
    } else if (/^\d+$/.test(part)) out.push(Number(part));
    else throw new Error("Seeds are whole numbers, for example 0, or 0, 1, 2, or 0-4");
  }
  if (!out.length) throw new Error("Give at least one seed");
  if (new Set(out).size !== out.length) throw new Error("A seed is given twice");
  return out;
}
