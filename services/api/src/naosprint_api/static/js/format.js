/** Numbers, times and sizes as text. Every function maps null, undefined and NaN to an en dash. */

const NONE = "–";
const missing = (v) => v === null || v === undefined || Number.isNaN(v);

/** 1234567 -> "1,234,567". */
export const integer = (v) => (missing(v) ? NONE : Math.round(v).toLocaleString("en-US"));

/** 1234567 -> "1.23M": three significant digits and `more`, for axes and cells. */
export function compact(v, more = 0) {
  if (missing(v)) return NONE;
  const a = Math.abs(v);
  for (const [unit, size] of [
    ["G", 1e9],
    ["M", 1e6],
    ["k", 1e3],
  ]) {
    if (a >= size * 0.99995) {
      const x = v / size;
      return trim(x.toFixed(more + (Math.abs(x) >= 100 ? 0 : Math.abs(x) >= 10 ? 1 : 2))) + unit;
    }
  }
  return trim(Number(v.toPrecision(4 + more)).toString());
}

/** Digits beyond those of a metric from which its numbers are scientific. */
export const SCIENTIFIC = 4;

/** Texts of the marks of an axis; `format` gets as many digits more as tell them apart, where some do. */
export function distinct(values, format) {
  const texts = [0, 1, 2, 3, SCIENTIFIC].map((more) => values.map((v) => format(v, more)));
  return texts.find((found) => new Set(found).size === found.length) ?? texts[0];
}
const trim = (t) => (t.includes(".") && !t.includes("e") ? t.replace(/0+$/, "").replace(/\.$/, "") : t);

/** Fixed decimals. */
export const fixed = (v, digits = 2) =>
  missing(v)
    ? NONE
    : v
        .toFixed(digits)
        .replace(/^-(?=0(\.0*)?$)/, "")
        .replace("-", "−");

/**
 * Significant digits, or all of a whole part that has more; scientific when tiny or huge, whole numbers from 1e9 on.
 */
export function significant(v, digits = 3) {
  if (missing(v)) return NONE;
  const a = Math.abs(v);
  if (a < (Number.isInteger(v) ? 1e9 : 1e6) && Math.abs(Number(v.toPrecision(digits))) >= 1000)
    return v.toLocaleString("en-US", { maximumFractionDigits: Math.max(0, digits - 4) }).replace("-", "−");
  if (a !== 0 && (a < 1e-3 || a >= 1e6))
    return v
      .toExponential(digits - 1)
      .replace(/\.?0+e/, "e")
      .replace("e-", "e−")
      .replace("e+", "e");
  return trim(v.toPrecision(digits)).replace(/^-/, "−");
}

/** A value of a metric without its unit: with its digits and `more`, fractions in percent. */
export function metricText(metric, v, more = 0) {
  if (missing(v)) return NONE;
  const value = metric.unit === "%" ? v * 100 : v;
  if (missing(metric.digits) || more >= SCIENTIFIC) return significant(value, 4);
  const digits = metric.digits + more;
  return value
    .toLocaleString("en-US", { minimumFractionDigits: digits, maximumFractionDigits: digits })
    .replace(/^-(?=0(\.0*)?$)/, "")
    .replace("-", "−");
}

/** A metric's unit as shown after a number; empty for none. */
export const shownUnit = (metric) => metric.unit ?? "";

/** A metric's title with its unit: "Top speed, m/s". */
export const titled = (metric) => [metric.title ?? words(metric.name), shownUnit(metric)].filter(Boolean).join(", ");

/** A value of a metric with its unit: "4.03 m/s", "0.4 %", "0.5°". */
export function withUnit(metric, v) {
  const text = metricText(metric, v);
  const unit = shownUnit(metric);
  return text === NONE || !unit ? text : unit === "°" ? `${text}${unit}` : `${text} ${unit}`;
}

/** An interval of a metric: "0.50 to 0.75"; null without one. */
export const intervalText = (metric, ends) =>
  ends ? `${metricText(metric, ends[0])} to ${metricText(metric, ends[1])}` : null;

/** 0.0731 -> "7.3 %". */
export const percent = (v, digits = 1) => (missing(v) ? NONE : `${(v * 100).toFixed(digits)} %`);

/** Seconds -> "42 s", "3 m 05 s", "1 h 04 m", "2 d 3 h". */
export function duration(v) {
  if (missing(v) || v < 0) return NONE;
  const t = Math.round(v);
  const two = (n) => String(n).padStart(2, "0");
  if (t < 60) return `${t} s`;
  if (t < 3600) return `${Math.floor(t / 60)} m ${two(t % 60)} s`;
  if (t < 86400) return `${Math.floor(t / 3600)} h ${two(Math.floor((t % 3600) / 60))} m`;
  return `${Math.floor(t / 86400)} d ${Math.floor((t % 86400) / 3600)} h`;
}

/** Seconds -> "350 ms", "2.4 s". */
export const shortTime = (v) => (v < 1 ? `${Math.round(1000 * v)} ms` : `${fixed(v, 1)} s`);

/** Bytes -> "812 B", "1.4 MB" (decimal units). */
export function bytes(v) {
  if (missing(v)) return NONE;
  for (const [unit, size] of [
    ["GB", 1e9],
    ["MB", 1e6],
    ["kB", 1e3],
  ])
    if (v >= size) return `${(v / size).toFixed(v >= 100 * size ? 0 : 1)} ${unit}`;
  return `${v} B`;
}

/** ISO time -> "just now", "4 min ago", "3 h ago", "2 d ago", "2026-03-12". */
export function ago(iso) {
  if (!iso) return NONE;
  const dt = (Date.now() - new Date(iso)) / 1000;
  if (dt < 45) return "just now";
  if (dt < 3600) return `${Math.max(1, Math.round(dt / 60))} min ago`;
  if (dt < 86400) return `${Math.round(dt / 3600)} h ago`;
  if (dt < 7 * 86400) return `${Math.round(dt / 86400)} d ago`;
  return day(iso);
}

/** ISO time -> "14:03:59" local. */
export const clock = (iso) => (iso ? new Date(iso).toLocaleTimeString("en-GB", { hour12: false }) : NONE);

/** ISO time -> "2026-03-14 14:03:59" local. */
export function stamp(iso) {
  if (!iso) return NONE;
  const d = new Date(iso);
  const two = (n) => String(n).padStart(2, "0");
  return `${d.getFullYear()}-${two(d.getMonth() + 1)}-${two(d.getDate())} ${two(d.getHours())}:${two(d.getMinutes())}:${two(d.getSeconds())}`;
}

/** ISO time -> "2026-03-14" local. */
export const day = (iso) => stamp(iso).slice(0, 10);

/** ISO time -> "2026-03-14 14:03" local. */
export const minute = (iso) => stamp(iso).slice(0, 16);

/** ISO time -> "14:03:59" today, "03-14 14:03" of another day, local. */
export const moment = (iso) => (day(iso) === day(new Date()) ? clock(iso) : minute(iso).slice(5));

/** "learning_rate" -> "Learning rate". */
export const words = (key) => key.replace(/_/g, " ").replace(/^./, (c) => c.toUpperCase());

/** Rows of cells as CSV. Text that a spreadsheet would take for a formula gets an apostrophe; numbers stay numbers. */
export function csv(rows) {
  const cell = (value) => {
    if (typeof value !== "string") return String(value ?? "");
    const text = /^[=+\-@\t\r]/.test(value) && Number.isNaN(Number(value)) ? `'${value}` : value;
    return /[",\r\n]/.test(text) ? `"${text.replace(/"/g, '""')}"` : text;
  };
  return rows.map((row) => `${row.map(cell).join(",")}\n`).join("");
}
