/** Plots of an evaluation as SVG, drawn for the width they have, so that text keeps its size. */

import { h, s } from "./dom.js";
import { CONTACT_N } from "./evaluation.js";
import { fixed } from "./format.js";

/** A plot that is drawn again when its width changes; `draw(width)` returns an SVG element. */
export class Figure {
  constructor(draw) {
    this.draw = draw;
    this.element = h("div", { class: "figure-box" });
    this.width = 0;
    this.observer = new ResizeObserver(() => {
      const width = Math.floor(this.element.clientWidth);
      if (width > 0 && width !== this.width) {
        this.width = width;
        this.redraw();
      }
    });
    this.observer.observe(this.element);
  }

  redraw() {
    if (this.width) this.element.replaceChildren(this.draw(this.width));
  }

  destroy() {
    this.observer.disconnect();
  }
}

export const svg = (width, height, label, ...kids) =>
  s(
    "svg",
    { class: "figure", viewBox: `0 0 ${width} ${height}`, width, height, role: "img", "aria-label": label },
    kids,
  );
export const path = (points) => points.map(([x, y], i) => `${i ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`).join("");

/** Round steps for about `count` ticks between two numbers. */
export function ticks(low, high, count) {
  const raw = (high - low) / Math.max(1, count);
  const size = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].map((k) => k * size).find((k) => k >= raw) ?? raw;
  const out = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i++)
    out.push(Number((i * step).toPrecision(12)));
  return out;
}

/** Axes of a plot: scales and the group that draws them. */
export function axes({
  width,
  height,
  x: [x0, x1],
  y: [y0, y1],
  xLabel,
  yLabel,
  xTicks,
  yTicks,
  left = 44,
  right = 12,
  top = 10,
  bottom = 36,
  xFormat = String,
  yFormat = String,
  yCount = 5,
}) {
  const sx = (v) => left + ((v - x0) / (x1 - x0)) * (width - left - right);
  const sy = (v) => height - bottom - ((v - y0) / (y1 - y0)) * (height - top - bottom);
  const group = s(
    "g",
    null,
    (yTicks ?? ticks(y0, y1, yCount)).map((v) => [
      s("line", { class: "grid", x1: left, x2: width - right, y1: sy(v), y2: sy(v) }),
      s("text", { x: left - 7, y: sy(v) + 4, "text-anchor": "end" }, yFormat(v)),
    ]),
    (xTicks ?? ticks(x0, x1, Math.max(2, Math.floor(width / 90)))).map((v) =>
      s("text", { x: sx(v), y: height - bottom + 16, "text-anchor": "middle" }, xFormat(v)),
    ),
    s("line", { class: "axis", x1: left, x2: width - right, y1: height - bottom, y2: height - bottom }),
    xLabel ? s("text", { x: (left + width - right) / 2, y: height - 3, "text-anchor": "middle" }, xLabel) : null,
    yLabel
      ? s("text", { x: -(top + height - bottom) / 2, y: 11, transform: "rotate(-90)", "text-anchor": "middle" }, yLabel)
      : null,
  );
  return { sx, sy, group, left, right, top, bottom };
}

/**
 * Results over a quantity, each series with its confidence band.
 *
 * @param {{token: string, label: string, rows: {at: number, mean: number, low: number, high: number}[], dash?:
 *   string}[]} series
 * @param {{xLabel: string, yLabel: string, xFormat: (v: number) => string, format: (v: number) => string, metric?:
 *   object, refs: {y: number, label: string}[]}} axis
 */
export function resultLines(width, series, { xLabel, yLabel, xFormat, format, metric, refs }) {
  const height = 290;
  const all = series.flatMap((x) => x.rows);
  const scale = metric?.unit === "%" ? 100 : 1;
  const top = Math.max(...all.map((r) => r.high), ...refs.map((r) => r.y)) * scale;
  const least = Math.min(0, ...all.map((r) => r.low)) * scale;
  const places = [...new Set(all.map((r) => r.at))].sort((a, b) => a - b);
  const margin = (places.at(-1) - places[0]) * 0.05 || 0.5;
  const a = axes({
    width,
    height,
    x: [places[0] - margin, places.at(-1) + margin],
    y: [least, top > least ? top * 1.05 : least + 1],
    xTicks: places,
    xLabel,
    yLabel,
    xFormat,
    left: 58,
  });
  const y = (v) => a.sy(v * scale);
  return svg(
    width,
    height,
    series
      .map((x) => `${x.label}: ${x.rows.map((r) => `${format(r.mean)} at ${xFormat(r.at)}`).join(", ")}`)
      .join("; "),
    a.group,
    refs.map((r) => [
      s("line", { class: "ref", x1: a.left, x2: width - a.right, y1: y(r.y), y2: y(r.y) }),
      s("text", { class: "ref-text", x: a.left + 4, y: y(r.y) - 4 }, r.label),
    ]),
    series.map((x) => [
      s("path", {
        d: `${path(x.rows.map((r) => [a.sx(r.at), y(r.high)]))}${path(x.rows.toReversed().map((r) => [a.sx(r.at), y(r.low)])).replace("M", "L")}Z`,
        fill: `var(${x.token})`,
        opacity: 0.16,
      }),
      s("path", {
        d: path(x.rows.map((r) => [a.sx(r.at), y(r.mean)])),
        fill: "none",
        stroke: `var(${x.token})`,
        "stroke-width": 1.75,
        "stroke-dasharray": x.dash ?? null,
      }),
      x.rows.map((r) =>
        s(
          "circle",
          {
            cx: a.sx(r.at),
            cy: y(r.mean),
            r: 3.2,
            fill: "var(--surface)",
            stroke: `var(${x.token})`,
            "stroke-width": 1.75,
          },
          s(
            "title",
            null,
            `${x.label}, at ${xFormat(r.at)}: ${format(r.mean)}, interval ${format(r.low)} to ${format(r.high)}`,
          ),
        ),
      ),
    ]),
  );
}

/**
 * Paths of the torso on the field, to scale.
 *
 * @param {import("./evaluation.js").Paths} paths
 * @param {{selected: number, half: number, onSelect: (i: number) => void}} options half: metres shown to each side of
 *   the middle
 */
export function field(width, paths, { selected, half, onSelect }) {
  const { length_m: length, goal, lines, circle_radius_m: radius } = paths.ground;
  const margin = 0.3 + (goal?.depth_m ?? 0);
  const x0 = -length / 2 - margin;
  const span = length + 2 * margin;
  const scale = width / span;
  const height = Math.ceil(2 * half * scale) + 22;
  const sx = (x) => (x - x0) * scale;
  const sy = (y) => (half - y) * scale;
  const clip = `field-${width}-${half}`;
  const markings = s(
    "g",
    { fill: "none", stroke: "var(--turf-line)", "stroke-width": 1.25 },
    lines.map(([ax, ay, bx, by]) => s("line", { x1: sx(ax), y1: sy(ay), x2: sx(bx), y2: sy(by) })),
    s("circle", { cx: sx(0), cy: sy(0), r: radius * scale }),
    (goal ? [-1, 1] : []).map((side) =>
      s("rect", {
        x: sx((side * length) / 2 - (side < 0 ? goal.depth_m : 0)),
        y: sy(goal.width_m / 2),
        width: goal.depth_m * scale,
        height: goal.width_m * scale,
      }),
    ),
  );
  const start = paths.episode(0).x[0];
  const gate = (x, label, anchor) => [
    s("line", {
      x1: sx(x),
      x2: sx(x),
      y1: 0,
      y2: 2 * half * scale,
      stroke: "var(--text)",
      "stroke-width": 1,
      "stroke-dasharray": "3 3",
      opacity: 0.6,
    }),
    s(
      "text",
      { x: sx(x) + (anchor === "end" ? -4 : 4), y: 12, "text-anchor": anchor, style: { fill: "var(--soft)" } },
      label,
    ),
  ];
  const every = (e) => Math.max(1, Math.floor(e.samples / 240));
  const line = (e) => {
    const points = [];
    for (let t = 0; t < e.samples; t += every(e)) points.push([sx(e.x[t]), sy(e.y[t])]);
    points.push([sx(e.x[e.samples - 1]), sy(e.y[e.samples - 1])]);
    return path(points);
  };
  const tokenOf = (e) => (e.failed ? "--s6" : "--s1");
  const mark = (e) => {
    const x = sx(e.x[e.samples - 1]);
    const y = sy(e.y[e.samples - 1]);
    return !e.failed
      ? s("circle", { cx: x, cy: y, r: 2, fill: `var(${tokenOf(e)})` })
      : s("path", { d: `M${x - 3} ${y - 3}l6 6m0 -6l-6 6`, stroke: `var(${tokenOf(e)})`, "stroke-width": 1.5 });
  };
  const episodes = paths.all();
  const one = (e, i, strong) =>
    s(
      "g",
      { "data-episode": i },
      s("path", {
        d: line(e),
        fill: "none",
        stroke: `var(${tokenOf(e)})`,
        "stroke-width": strong ? 2.25 : 1,
        opacity: strong ? 1 : 0.34,
      }),
      s("g", { opacity: strong ? 1 : 0.55 }, mark(e)),
    );
  const hit = episodes.map((e, i) =>
    s(
      "path",
      {
        d: line(e),
        fill: "none",
        stroke: "transparent",
        "stroke-width": 7,
        "pointer-events": "stroke",
        style: { cursor: "pointer" },
        onclick: () => onSelect(i),
      },
      s(
        "title",
        null,
        `Episode ${i + 1}: ${fixed(e.distance, 2)} m in ${fixed(e.seconds, 2)} s, ${fixed(e.speed)} m/s`,
      ),
    ),
  );
  const step = length > 40 ? 10 : 5;
  const most = Math.floor(length / 2 / step);
  const marks = Array.from({ length: 2 * most + 1 }, (_, i) => (i - most) * step);
  return svg(
    width,
    height,
    `Paths of ${paths.count} episodes on the field, seen from above; ${episodes.filter((e) => e.failed).length} failed`,
    s("defs", null, s("clipPath", { id: clip }, s("rect", { x: 0, y: 0, width, height: 2 * half * scale, rx: 4 }))),
    s(
      "g",
      { "clip-path": `url(#${clip})` },
      s("rect", { x: 0, y: 0, width, height: 2 * half * scale, fill: "var(--turf)" }),
      markings,
      gate(start, "start", "start"),
      paths.lines.map((line) => gate(line.x_m, line.title, "end")),
      episodes.map((e, i) => (i === selected ? null : one(e, i, false))),
      one(episodes[selected], selected, true),
      hit,
    ),
    marks.map((x) =>
      s(
        "text",
        { x: sx(x), y: 2 * half * scale + 16, "text-anchor": "middle" },
        `${x === 0 ? "0" : x} m`.replace("-", "−"),
      ),
    ),
  );
}

/** A histogram of numbers. */
export function histogram(width, values, { label, format, token = "--s1", bins = 20 }) {
  const height = 200;
  const high = Math.max(...values, 1e-6) * 1.0001;
  const counts = new Array(bins).fill(0);
  for (const v of values) counts[Math.min(bins - 1, Math.floor((v / high) * bins))] += 1;
  const a = axes({
    width,
    height,
    x: [0, high],
    y: [0, Math.max(...counts) * 1.08],
    xLabel: label,
    yLabel: "episodes",
    xFormat: format,
    yCount: 4,
  });
  const w = (a.sx(high) - a.sx(0)) / bins;
  return svg(
    width,
    height,
    `${label}: ${values.length} episodes`,
    a.group,
    counts.map((c, i) =>
      c
        ? s(
            "rect",
            {
              x: a.sx((high * i) / bins) + 0.75,
              y: a.sy(c),
              width: Math.max(1, w - 1.5),
              height: a.sy(0) - a.sy(c),
              rx: 1.5,
              fill: `var(${token})`,
              opacity: 0.8,
            },
            s("title", null, `${c} episodes from ${format((high * i) / bins)} to ${format((high * (i + 1)) / bins)}`),
          )
        : null,
    ),
  );
}

/**
 * Gait diagram: when each foot carries load, and how much.
 *
 * @param {object} episode one episode of Paths
 * @param {number} cycle seconds per sample
 * @param {number} from first second shown
 * @param {number} seconds length shown
 */
export function gaitDiagram(width, episode, cycle, from, seconds) {
  const height = 250;
  const left = 54;
  const right = 12;
  const bars = 74;
  const bottom = 36;
  const first = Math.floor(from / cycle);
  const last = Math.min(episode.samples - 1, Math.ceil((from + seconds) / cycle));
  let peak = 60;
  for (let t = 0; t < episode.samples; t++)
    peak = Math.max(peak, Math.min(400, episode.left[t]), Math.min(400, episode.right[t]));
  const a = axes({
    width,
    height,
    x: [from, from + seconds],
    y: [0, peak],
    left,
    right,
    top: bars + 8,
    bottom,
    xLabel: "time since the start, s",
    yLabel: "",
    xFormat: (v) => fixed(v, seconds > 4 ? 0 : 1),
    yFormat: (v) => `${v} N`,
    yCount: 3,
  });
  const feet = [
    ["Left", "left", "--s1", 8],
    ["Right", "right", "--s2", 40],
  ];
  const spans = (test) => {
    const out = [];
    let begin = null;
    for (let t = first; t <= last + 1; t++) {
      const on = t <= last && test(t);
      if (on && begin === null) begin = t;
      if (!on && begin !== null) {
        out.push([begin, t]);
        begin = null;
      }
    }
    return out;
  };
  const clampX = (t) => Math.max(left, Math.min(width - right, a.sx(t * cycle)));
  const flight = spans((t) => episode.left[t] < CONTACT_N && episode.right[t] < CONTACT_N);
  return svg(
    width,
    height,
    `Ground contact of both feet from ${fixed(from, 1)} s to ${fixed(from + seconds, 1)} s`,
    a.group,
    flight.map(([b, e]) =>
      s("rect", {
        x: clampX(b),
        y: 4,
        width: Math.max(0, clampX(e) - clampX(b)),
        height: height - bottom - 4,
        fill: "var(--ref)",
        opacity: 0.12,
      }),
    ),
    feet.map(([name, key, token, y]) => [
      s("text", { x: left - 7, y: y + 16, "text-anchor": "end" }, name),
      s("rect", { x: left, y, width: width - left - right, height: 24, fill: "var(--grey-soft)", rx: 3 }),
      spans((t) => episode[key][t] >= CONTACT_N).map(([b, e]) =>
        s(
          "rect",
          {
            x: clampX(b),
            y: y + 2,
            width: Math.max(1, clampX(e) - clampX(b)),
            height: 20,
            rx: 2,
            fill: `var(${token})`,
          },
          s("title", null, `${name} foot on the ground for ${fixed((e - b) * cycle, 2)} s`),
        ),
      ),
      s("path", {
        d: path(
          Array.from({ length: Math.max(0, last - first + 1) }, (_, i) => [
            clampX(first + i),
            a.sy(Math.min(peak, episode[key][first + i])),
          ]),
        ),
        fill: "none",
        stroke: `var(${token})`,
        "stroke-width": 1.4,
      }),
    ]),
  );
}
