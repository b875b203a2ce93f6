/** Read form fields out of a JSON schema and text out of form fields. Knows nothing of any single field. */

import { words } from "./format.js";

/** Follow $ref and single-entry allOf. */
export function resolve(schema, root) {
  let node = schema;
  for (let i = 0; i < 10 && node; i++) {
    if (node.$ref) {
      const target = node.$ref.replace(/^#\//, "").split("/").reduce((at, key) => at?.[key], root);
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
 * Describe one property as a field.
 *
 * @returns {{name: string, label: string, hint: string, unit: string|null, kind: "choice"|"flag"|"integer"|"number"|"list"|"text", nullable: boolean, choices?: any[], low?: number, high?: number, openLow?: boolean, openHigh?: boolean, fallback: any}}
 */
export function field(name, schema, root) {
  const outer = resolve(schema, root);
  let inner = outer, nullable = false;
  if (outer.anyOf) {
    const options = outer.anyOf.map((o) => resolve(o, root));
    nullable = options.some((o) => o.type === "null");
    const rest = options.filter((o) => o.type !== "null");
    inner = rest.length === 1 ? { ...rest[0], ...Object.fromEntries(Object.entries(outer).filter(([k]) => k !== "anyOf")) } : outer;
  }
  const low = inner.minimum ?? inner.exclusiveMinimum, high = inner.maximum ?? inner.exclusiveMaximum;
  // Without a title of its own a field gets one made of its name, with every word in capitals.
  const given = outer.title && outer.title.toLowerCase() !== name.replace(/_/g, " ") ? outer.title : null;
  const base = { name, label: given ?? words(name), hint: outer.description ?? "", unit: outer.unit ?? null, nullable, low, high, openLow: inner.exclusiveMinimum !== undefined, openHigh: inner.exclusiveMaximum !== undefined, fallback: outer.default };
  const choices = inner.enum ?? (inner.const !== undefined ? [inner.const] : null);
  if (choices) return { ...base, kind: "choice", choices: nullable ? [...choices.filter((c) => c !== null), null] : choices };
  if (inner.type === "boolean") return { ...base, kind: "flag" };
  if (inner.type === "integer" && low !== undefined && high !== undefined && high - low <= 9) return { ...base, kind: "choice", choices: Array.from({ length: high - low + 1 }, (_, i) => low + i) };
  if (inner.type === "integer" || inner.type === "number") return { ...base, kind: inner.type };
  if (inner.type === "array") return { ...base, kind: "list" };
  return { ...base, kind: "text" };
}

const SUFFIX = { k: 1e3, M: 1e6, m: 1e6, G: 1e9 };

/** Read a number as people type it: 10M, 200k, 1e6, 10,000,000, 10_000_000. NaN when it is none. */
export function number(text) {
  const match = /^([+-]?(?:\d[\d,_ ]*)?(?:\.\d*)?(?:e[+-]?\d+)?)\s*([kMmG]?)$/i.exec(text.trim());
  if (!match || !/\d/.test(match[1])) return NaN;
  const value = Number(match[1].replace(/[,_ ]/g, ""));
  const scale = match[2] ? SUFFIX[match[2]] ?? SUFFIX[match[2].toLowerCase()] ?? 1 : 1;
  return Number((value * scale).toPrecision(15));
}

/** Show a value in its field. */
export function toText(f, value) {
  if (value === null || value === undefined) return "";
  if (f.kind === "list") return value.join(", ");
  if (f.kind === "integer" && Math.abs(value) >= 10_000) return value.toLocaleString("en-US");
  return String(value);
}

/** Read a field's text; throws an Error with what is wrong and what is right. */
export function fromText(f, text) {
  const t = text.trim();
  if (f.kind === "list") {
    const values = t === "" ? [] : t.split(/[\s,;×x]+/).filter(Boolean).map(Number);
    if (values.some((v) => !Number.isInteger(v) || v < 1)) throw new Error("Whole numbers separated by commas, for example 64, 64");
    return values;
  }
  if (f.kind === "text") return t === "" && f.nullable ? null : t;
  if (t === "") {
    if (f.nullable) return null;
    throw new Error("A number is needed here");
  }
  const value = number(t);
  if (Number.isNaN(value)) throw new Error("Not a number; 250000, 250k and 2.5e5 all work");
  if (f.kind === "integer" && !Number.isInteger(value)) throw new Error("A whole number is needed here");
  if (f.low !== undefined && (f.openLow ? value <= f.low : value < f.low)) throw new Error(`Must be ${f.openLow ? "more than" : "at least"} ${f.low}`);
  if (f.high !== undefined && (f.openHigh ? value >= f.high : value > f.high)) throw new Error(`Must be ${f.openHigh ? "less than" : "at most"} ${f.high.toLocaleString("en-US")}`);
  return value;
}

/** Read "0, 1, 2" or "0-4" as a list of seeds. */
export function seeds(text) {
  const out = [];
  for (const part of text.split(/[\s,;]+/).filter(Boolean)) {
    const range = /^(\d+)\s*(?:-|–|\.\.)\s*(\d+)$/.exec(part);
    if (range) {
      const [a, b] = [Number(range[1]), Number(range[2])];
      if (b < a || b - a > 255) throw new Error("A range goes up and holds at most 256 seeds");
      for (let i = a; i <= b; i++) out.push(i);
    } else if (/^\d+$/.test(part)) out.push(Number(part));
    else throw new Error("Seeds are whole numbers from 0 on: 0, or 0, 1, 2, or 0-4");
  }
  if (!out.length) throw new Error("Give at least one seed");
  if (new Set(out).size !== out.length) throw new Error("A seed stands here twice");
  return out;
}
