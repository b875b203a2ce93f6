/** Plots of jobs and trials as SVG: two values against each other, and parallel coordinates. */

import { s } from "./dom.js";
import { axes, path, svg, ticks } from "./figures.js";
import { compact, distinct, metricText, significant, titled } from "./format.js";

const HEIGHT = 320;
/** Least distance of parallel axes, pixels. */
const PITCH = 104;
/** Ratio of the ends from which positive numbers without a description are on a logarithmic scale. */
const LOGARITHMIC = 20;
/** Most values on an axis of choices that are labelled. */
const MOST_LABELS = 12;

export const missing = (value) => value === null || value === undefined || Number.isNaN(value);
const textOf = (value) => (typeof value === "string" ? value : JSON.stringify(value));
const short = (text, most = 16) => (text.length > most ? `${text.slice(0, most - 1)}…` : text);

/** Axis of values that are not numbers: each value has a place of its own. */
function choices(title, values) {
  const options = [...new Set(values.map(textOf))];
  const place = (value) => (options.length > 1 ? options.indexOf(textOf(value)) / (options.length - 1) : 0.5);
  const step = Math.ceil(options.length / MOST_LABELS);
  const marks = options.filter((_, i) => i % step === 0).map((text) => [place(text), text]);
  const parse = (value) => place(textOf(value));
  return { title, place: parse, marks, format: textOf };
}

/** A number without a description. */
const plainText = (value, more = 0) => (Math.abs(value) >= 1e4 ? compact(value) : significant(value, 3 + more));

/** Powers of ten between two numbers; the ends, if there are fewer than two. */
function decades(low, high) {
  const found = [];
  for (let power = Math.ceil(Math.log10(low)); 10 ** power <= high; power++) found.push(10 ** power);
  return found.length > 1 ? found : [low, high];
}

/**
 * Axis of a plot: `place` of a value from 0 to 1, `marks` with place and text, `format` of a value.
 *
 * @param {string} title
 * @param {any[]} values what it has to show
 * @param {{choices?: any[], low?: number, high?: number, log?: boolean, format?: (v: any, more?: number) => string}}
 *   known what is known of it, such as the range that a study searches; `more` are digits that tell the marks apart
 */
export function axisOf(title, values, known = {}) {
  const present = values.filter((value) => !missing(value));
  if (known.choices) return choices(title, known.choices);
  if (!present.every((value) => typeof value === "number")) return choices(title, present.sort());
  const format = known.format ?? plainText;
  const low = known.low ?? Math.min(...present);
  const high = known.high ?? Math.max(...present);
  const log = known.log ?? (low > 0 && high / low >= LOGARITHMIC);
  const scale = log ? Math.log : (v) => v;
  const place = (v) => (high > low ? (scale(v) - scale(low)) / (scale(high) - scale(low)) : 0.5);
  const at = high > low ? (log ? decades(low, high) : ticks(low, high, 5)) : [low];
  const shown = distinct(at, format);
  return { title, place, format, marks: at.map((v, i) => [place(v), shown[i]]) };
}

/** Axis of a metric with a description; its marks have more digits where they need them to differ. */
export function metricAxis(metric, values) {
  if (missing(metric.digits)) return axisOf(titled(metric), values);
  return axisOf(titled(metric), values, { format: (value, more) => metricText(metric, value, more) });
}

/** What a row of a plot is drawn with; `props` are those of its shape. */
const mark = (row, tag, props, token) => {
  const shape = s(
    tag,
    { ...props, class: "plot-mark", style: { "--mark": `var(${token})` } },
    s("title", null, row.label),
  );
  // not a stop of the Tab key: the table beside the plot has the same links
  return row.href ? s("a", { href: row.href, tabindex: -1, "aria-label": row.label }, shape) : shape;
};

/** A plot whose marks are links; it keeps its width where its box is narrower. */
function linked(width, label, ...kids) {
  const plot = svg(width, HEIGHT, label, kids);
  plot.setAttribute("role", "group");
  plot.style.minWidth = `${width}px`;
  return plot;
}

/** Rows in the order of drawing: those that stand out last. */
const inOrder = (rows) => [...rows].sort((a, b) => Number(a.strong ?? false) - Number(b.strong ?? false));
const tokenOf = (row) => row.token ?? (row.strong ? "--s2" : "--s1");

/**
 * Two values of each row against each other.
 *
 * @param {number} width
 * @param {object[]} columns two axes, x and y
 * @param {{label: string, href?: string, token?: string, strong?: boolean, values: any[]}[]} rows their values in the
 *   order of the axes; a row without both is left out
 * @param {string} label what it shows, for those who do not see it
 */
export function scatter(width, [x, y], rows, label) {
  const drawn = inOrder(rows.filter(({ values }) => !values.slice(0, 2).some(missing)));
  const labels = (axis) => (place) => short(axis.marks.find(([at]) => at === place)[1]);
  const longest = Math.max(...y.marks.map(([, text]) => short(text).length), 3);
  const plane = axes({
    width,
    height: HEIGHT,
    left: 30 + 6.5 * longest,
    x: [-0.04, 1.04],
    y: [-0.06, 1.06],
    xLabel: x.title,
    yLabel: y.title,
    xTicks: x.marks.map(([at]) => at),
    yTicks: y.marks.map(([at]) => at),
    xFormat: labels(x),
    yFormat: labels(y),
  });
  return linked(
    width,
    label,
    plane.group,
    drawn.map((row) => {
      const [cx, cy] = [plane.sx(x.place(row.values[0])), plane.sy(y.place(row.values[1]))];
      return mark(row, "circle", { cx, cy, r: row.strong ? 5.5 : 4, fill: "var(--mark)" }, tokenOf(row));
    }),
  );
}

/** A line through the places of a row; it has gaps where the row has no value. */
function line(row, columns, x, y) {
  const points = columns.map((column, i) => (missing(row.values[i]) ? null : [x(i), y(column.place(row.values[i]))]));
  const parts = [];
  for (const point of points)
    if (point === null) parts.push([]);
    else if (parts.length) parts.at(-1).push(point);
    else parts.push([point]);
  return parts.map(path).join("");
}

/** Parallel coordinates: a line for each row through its values; parameters as those of `scatter`. */
export function parallel(given, columns, rows, label) {
  const width = Math.max(given, PITCH * columns.length);
  const margin = PITCH / 2;
  const x = (i) => (columns.length > 1 ? margin + (i / (columns.length - 1)) * (width - 2 * margin) : width / 2);
  const y = (share) => HEIGHT - 28 - share * (HEIGHT - 66);
  return linked(
    width,
    label,
    inOrder(rows).map((row) =>
      mark(
        row,
        "path",
        {
          d: line(row, columns, x, y),
          fill: "none",
          stroke: "var(--mark)",
          "stroke-width": row.strong ? 2.5 : 1.25,
          opacity: row.strong || rows.length < 10 ? 1 : 0.55,
        },
        tokenOf(row),
      ),
    ),
    columns.map((column, i) => [
      s("line", { class: "axis", x1: x(i), x2: x(i), y1: y(0), y2: y(1) }),
      s(
        "text",
        { x: x(i), y: 14, "text-anchor": "middle", class: "title" },
        short(column.title),
        s("title", null, column.title),
      ),
      column.marks.map(([at, text]) => s("text", { class: "halo", x: x(i) + 5, y: y(at) + 4 }, short(text, 12))),
    ]),
  );
}
