/**
 * Line charts on a canvas (uPlot), themed by CSS tokens, with reference lines, bands, linked cursors and linked zoom.
 */

import { h, setText } from "./dom.js";
import { compact, distinct, fixed } from "./format.js";
import { color, onTheme } from "./theme.js";

/** Colour tokens for series, in order. */
export const PALETTE = ["--s1", "--s2", "--s3", "--s4", "--s5", "--s6", "--s7", "--s8"];

/** Mix a token's colour with transparency. */
function faded(token, alpha) {
  const hex = color(token);
  const n = Number.parseInt(hex.slice(1), 16);
  return `rgb(${n >> 16} ${(n >> 8) & 255} ${n & 255} / ${alpha})`;
}

/** Color of a line. */
const ink = ({ token, raw }) => (raw ? faded(token, 0.28) : token.startsWith("--") ? color(token) : token);

/** Smooth by an exponential moving average with bias correction; `weight` in [0, 1). Gaps stay gaps. */
export function smooth(values, weight) {
  if (!weight) return values;
  const out = new Array(values.length);
  let mean = 0;
  let norm = 0;
  for (let i = 0; i < values.length; i++) {
    const v = values[i];
    if (v === null || v === undefined) {
      out[i] = null;
      continue;
    }
    mean = mean * weight + v * (1 - weight);
    norm = norm * weight + (1 - weight);
    out[i] = mean / norm;
  }
  return out;
}

/**
 * Leave out points that no screen shows: of each of `width` runs of points between `from` and `to` only the lowest and
 * highest of every series stay.
 * Outside of that range fewer runs do. The first and the last point always stay. Short columns come back as they are.
 */
export function thin(columns, from, to, width) {
  const x = columns[0];
  const n = x.length;
  const lines = columns.slice(1);
  if (n <= 4 * width || lines.length > 4) return columns;
  const at = (value) => {
    let low = 0;
    let high = n;
    while (low < high) {
      const mid = (low + high) >> 1;
      if (x[mid] < value) low = mid + 1;
      else high = mid;
    }
    return low;
  };
  const a = Math.max(0, at(from) - 1);
  const b = Math.min(n, at(to) + 1);
  const kept = [0];
  const keep = (i) => {
    if (i > kept.at(-1)) kept.push(i);
  };
  const section = (begin, end, runs) => {
    const size = (end - begin) / runs;
    if (size <= 4) {
      for (let i = begin; i < end; i++) keep(i);
      return;
    }
    for (let k = 0; k < runs; k++) {
      const low = begin + Math.floor(k * size);
      const high = begin + Math.floor((k + 1) * size);
      const picks = [low];
      for (const line of lines) {
        let least = -1;
        let most = -1;
        for (let i = low; i < high; i++) {
          const v = line[i];
          if (v === null || v === undefined) continue;
          if (least < 0 || v < line[least]) least = i;
          if (most < 0 || v > line[most]) most = i;
        }
        if (least >= 0) picks.push(least, most);
      }
      picks.sort((i, j) => i - j).forEach(keep);
    }
  };
  const rough = Math.ceil(width / 8);
  section(0, a, rough);
  section(a, b, width);
  section(b, n, rough);
  keep(n - 1);
  return columns.map((column) => kept.map((i) => column[i]));
}

/** Ends of an axis around values, with a share of their range as room; it crosses zero only where the values do. */
export function padded(low, high, room = 0.07) {
  const space = (high - low) * room || Math.abs(low) * 0.1 || 1;
  const [from, to] = [low - space, high + space];
  return [low < 0 ? from : Math.max(0, from), high > 0 || low === 0 ? to : Math.min(0, to)];
}

/** Milliseconds of one frame that charts may take; those that do not fit are drawn in the next one. */
const BUDGET_MS = 8;
const waiting = new Set();
const linked = new Map();
let _frame = 0;

function schedule(chart) {
  waiting.add(chart);
  _frame ||= requestAnimationFrame(work);
}

function work() {
  _frame = 0;
  const end = performance.now() + BUDGET_MS;
  for (const chart of waiting) {
    waiting.delete(chart);
    chart.draw();
    if (performance.now() > end) break;
  }
  if (waiting.size) _frame = requestAnimationFrame(work);
}

const FONT = () => `11px ${getComputedStyle(document.body).fontFamily}`;

/**
 * One chart in a card.
 *
 * @param {{title: string, unit?: string, series: {label: string, token: string, raw?: boolean, width?: number, dash?:
 *   number[]}[], bands?: {series: [number, number], token: string}[],
 *   lines?: [string, string, string][], min?: number, max?: number, refs?: {y: number, label: string}[], format?: (v:
 *   number) => string, xFormat?: (v: number) => string, sync?: string, empty?: string, height?: string}} options
 */
export class Chart {
  constructor(options) {
    this.options = {
      format: (v) => fixed(v, 2),
      xFormat: compact,
      refs: [],
      bands: [],
      empty: "No figures yet.",
      ...options,
    };
    this.now = h("span", { class: "now" });
    this.at = h("span", { class: "at" });
    this.none = h("div", { class: "none" }, this.options.empty);
    this.plot = h(
      "div",
      { class: ["plot", this.options.height], role: "img", "aria-label": `${options.title}: no figures yet` },
      this.none,
    );
    this.element = h(
      "section",
      { class: "card chart", "data-chart": options.key ?? options.title },
      h(
        "div",
        { class: "head" },
        h("h3", null, options.title, options.unit ? h("span", { class: "unit" }, options.unit) : null),
        options.lines
          ? h(
              "span",
              { class: "legend" },
              options.lines.map(([, label, token]) =>
                h("span", null, h("i", { style: { background: `var(${token})` } }), label),
              ),
            )
          : null,
        this.at,
        this.now,
      ),
      this.plot,
    );
    this.vertical = { log: false, range: [null, null] };
    this.source = null;
    this.data = null; // all columns
    this.shown = null; // what is left of them for the width and zoom
    this.span = null; // [from, to] of x while zoomed
    this.u = null;
    this.visible = true;
    this.resize = new ResizeObserver(() => this.#fit());
    this.resize.observe(this.plot);
    this.sight = new IntersectionObserver(
      ([entry]) => {
        this.visible = entry.isIntersecting;
        if (this.visible && this.late) schedule(this);
      },
      { rootMargin: "200px" },
    );
    this.sight.observe(this.plot);
    const key = options.sync ?? this;
    linked.set(key, (linked.get(key) ?? new Set()).add(this));
    this.links = linked.get(key);
    this.unlink = () => {
      this.links.delete(this);
      if (!this.links.size) linked.delete(key);
    };
    this.stopTheme = onTheme(() => this.#recolour());
  }

  /** Show columns: x first, then one per series; or a function that returns them, called when there is time to draw. */
  setData(columns) {
    this.source = typeof columns === "function" ? columns : () => columns;
    schedule(this);
  }

  /** Set the vertical axis: logarithmic or not, and its ends; null for one that follows the data. */
  setVertical({ log, range }) {
    const key = `${log} ${range}`;
    if (key === this.verticalKey) return;
    this.verticalKey = key;
    this.vertical = { log, range };
    this.u?.destroy();
    this.u = null;
    if (this.source) schedule(this);
  }

  /** Show a part of x only, [from, to], or all of it, in every linked chart; this one is drawn first. */
  zoom(span) {
    for (const chart of [this, ...this.links]) {
      chart.span = span;
      chart.u?.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
      schedule(chart);
    }
  }

  destroy() {
    waiting.delete(this);
    this.unlink();
    this.resize.disconnect();
    this.sight.disconnect();
    this.stopTheme();
    this.u?.destroy();
    this.u = null;
  }

  #fit() {
    if (!this.u) {
      if (this.source) schedule(this);
      return;
    }
    const [width, height] = this.#size();
    if (width > 0 && (width !== this.u.width || height !== this.u.height)) {
      this.u.setSize({ width, height });
      schedule(this); // another width shows other points
    }
  }

  /** Draw it in the colours of the theme, also out of view: the page may be about to be printed. */
  #recolour() {
    if (this.late) {
      const seen = this.visible;
      this.visible = true;
      this.draw();
      this.visible = seen;
    }
    this.u?.redraw(false, true);
  }

  #size() {
    const style = getComputedStyle(this.plot);
    return [
      Math.floor(this.plot.clientWidth - parseFloat(style.paddingLeft) - parseFloat(style.paddingRight)),
      Math.floor(this.plot.clientHeight - parseFloat(style.paddingTop) - parseFloat(style.paddingBottom)),
    ];
  }

  /** Draw the newest data; a chart out of view is drawn once it comes into view. */
  draw() {
    this.late = Boolean(this.u) && !this.visible;
    if (this.late || !this.source) return;
    const positive = (column) => column.map((v) => (v > 0 ? v : null));
    const given = this.source();
    const columns = this.vertical.log ? [given[0], ...given.slice(1).map(positive)] : given;
    this.data = columns;
    const any = columns[0].length > 0 && columns.slice(1).some((c) => c.some((v) => v !== null && v !== undefined));
    this.none.hidden = any;
    if (!any) {
      this.u?.destroy();
      this.u = null;
      setText(this.now, "");
      return;
    }
    if (!this.u) {
      const [width, height] = this.#size();
      if (width <= 0 || height <= 0) return;
      this.shown = thin(columns, columns[0][0], columns[0].at(-1), width);
      this.u = new uPlot(this.#config(width, height), this.shown, this.plot);
      if (this.span) schedule(this);
    } else {
      const [min, max] = this.span ?? [columns[0][0], columns[0].at(-1)];
      this.shown = thin(columns, min, max, this.u.width);
      // In one batch, drawn before it returns: else it is drawn twice, and unseen by the frame's budget.
      this.u.batch(() => {
        this.u.setData(this.shown, !this.span);
        if (this.span) this.u.setScale("x", { min, max });
      });
    }
    this.#readout(null);
    const last = this.#last(columns);
    this.plot.setAttribute(
      "aria-label",
      `${this.options.title}: ${columns[0].length} points` +
        (last
          ? `, latest ${this.options.format(last.value)} ${this.options.unit ?? ""} at ${this.options.xFormat(last.x)}`
          : ""),
    );
  }

  /** The main series' value at an index, or the last one before it. */
  #last(columns, index) {
    const column = columns[this.options.mainSeries ?? this.options.series.length];
    for (let i = index ?? column.length - 1; i >= 0; i--) {
      if (column[i] !== null && column[i] !== undefined) return { x: columns[0][i], value: column[i] };
      if (index !== undefined && index - i > 50) break;
    }
    return null;
  }

  #readout(index) {
    if (this.options.readout === false) return;
    const pointed = index !== null && index !== undefined;
    const at = pointed ? this.#last(this.shown, index) : this.#last(this.data);
    setText(this.now, at ? this.options.format(at.value) : "");
    setText(this.at, at && pointed ? this.options.xFormat(at.x) : "");
  }

  #range(_u, low, high) {
    const { min, max, refs } = this.options;
    const { log, range } = this.vertical;
    const [least, most] = range;
    if (low === null || high === null || low === undefined) return log ? [1, 10] : [min ?? 0, max ?? 1];
    if (log) {
      const [from, to] = uPlot.rangeLog(low, high, 10, false);
      return [least > 0 ? least : from, most > 0 ? most : to];
    }
    for (const ref of refs)
      if (ref.keep !== false) {
        low = Math.min(low, ref.y);
        high = Math.max(high, ref.y);
      }
    const ends = padded(low, high);
    const from = least ?? (min !== undefined ? Math.min(min, low) : ends[0]);
    const to = most ?? (max !== undefined ? Math.max(max, high) : ends[1]);
    return from < to ? [from, to] : [from, from + 1];
  }

  #config(width, height) {
    const o = this.options;
    const axis = {
      stroke: () => color("--axis"),
      font: FONT(),
      grid: { stroke: () => color("--grid"), width: 1 },
      ticks: { show: false },
      gap: 6,
    };
    return {
      width,
      height,
      padding: [10, 16, 0, 0],
      legend: { show: false },
      cursor: {
        y: false,
        points: { size: 7, width: 2, stroke: (_u, i) => color(o.series[i - 1].token), fill: () => color("--surface") },
        drag: { x: true, y: false, setScale: false },
        // Pointers are linked by uPlot; zooms are ours, so that not all charts are drawn in one frame.
        bind: { dblclick: () => () => this.zoom(null) },
        ...(o.sync
          ? {
              sync: {
                key: o.sync,
                scales: ["x", null],
                filters: { pub: (type) => type === "mousemove" || type === "mouseleave", sub: () => true },
              },
            }
          : {}),
      },
      scales: { x: { time: false }, y: { distr: this.vertical.log ? 3 : 1, range: (u, a, b) => this.#range(u, a, b) } },
      axes: [
        {
          ...axis,
          size: 26,
          space: (_u, _axis, low) => Math.max(50, 14 + 6.3 * o.xFormat(low).length),
          values: (_u, ticks) => distinct(ticks, o.xFormat),
        },
        {
          ...axis,
          size: (_u, labels) => Math.max(46, 16 + 6.3 * Math.max(0, ...(labels ?? []).map((t) => t.length))),
          space: 34,
          values: (_u, ticks) => distinct(ticks, o.axisFormat ?? compact),
        },
      ],
      series: [
        {},
        ...o.series.map((line) => ({
          label: line.label,
          spanGaps: true,
          width: line.width ?? (line.raw ? 1 : 1.75),
          dash: line.dash,
          points: {
            // a line of a single value is a point
            show: (u, i) => !line.hidden && u.data[i].filter((v) => v !== null && v !== undefined).length === 1,
            size: 6,
            fill: () => ink(line),
          },
          stroke: () => ink(line),
          paths: line.hidden ? () => null : undefined,
        })),
      ],
      bands: o.bands.map((band) => ({ series: band.series, fill: () => faded(band.token, 0.15) })),
      hooks: {
        setCursor: [(u) => this.#readout(u.cursor.idx)],
        setSelect: [
          (u) => {
            const { left, width: wide } = u.select;
            if (wide >= 4) this.zoom([u.posToVal(left, "x"), u.posToVal(left + wide, "x")]);
          },
        ],
        drawClear: [(u) => this.#drawRefs(u)],
      },
    };
  }

  #drawRefs(u) {
    const { ctx, bbox } = u;
    const dpr = devicePixelRatio;
    ctx.save();
    ctx.font = `${10.5 * dpr}px ${getComputedStyle(document.body).fontFamily}`;
    for (const ref of this.options.refs) {
      if (ref.y < u.scales.y.min || ref.y > u.scales.y.max) continue;
      const y = Math.round(u.valToPos(ref.y, "y", true)) + 0.5;
      ctx.strokeStyle = color("--ref");
      ctx.lineWidth = dpr;
      ctx.setLineDash([4 * dpr, 3 * dpr]);
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
      ctx.stroke();
      ctx.fillStyle = color("--muted");
      ctx.textAlign = "left";
      ctx.textBaseline = "bottom";
      ctx.fillText(ref.label, bbox.left + 4 * dpr, y - 2 * dpr);
    }
    ctx.restore();
  }
}
