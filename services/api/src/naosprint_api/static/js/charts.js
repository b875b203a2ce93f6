/** Line charts on a canvas (uPlot), themed by CSS tokens, with reference lines, bands, linked cursors and linked zoom. */

import { h, setText } from "./dom.js";
import { compact, fixed } from "./format.js";
import { color, onTheme } from "./theme.js";

/** Colour tokens for series, in order. */
export const PALETTE = ["--s1", "--s2", "--s3", "--s4", "--s5", "--s6", "--s7", "--s8"];

/** Mix a token's colour with transparency. */
export function faded(token, alpha) {
  const hex = color(token);
  const n = Number.parseInt(hex.slice(1), 16);
  return `rgb(${n >> 16} ${(n >> 8) & 255} ${n & 255} / ${alpha})`;
}

/** Smooth by an exponential moving average with bias correction; `weight` in [0, 1). Gaps stay gaps. */
export function smooth(values, weight) {
  if (!weight) return values;
  const out = new Array(values.length);
  let mean = 0, norm = 0;
  for (let i = 0; i < values.length; i++) {
    const v = values[i];
    if (v === null || v === undefined) { out[i] = null; continue; }
    mean = mean * weight + v * (1 - weight);
    norm = norm * weight + (1 - weight);
    out[i] = mean / norm;
  }
  return out;
}

const FONT = () => `11px ${getComputedStyle(document.body).fontFamily}`;

/**
 * One chart in a card.
 *
 * @param {{title: string, unit?: string, series: {label: string, token: string, raw?: boolean, width?: number, dash?: number[]}[], bands?: {series: [number, number], token: string}[],
 *   lines?: [string, string, string][], min?: number, max?: number, refs?: {y: number, label: string}[], format?: (v: number) => string, xFormat?: (v: number) => string, sync?: string, empty?: string, height?: string}} options
 */
export class Chart {
  constructor(options) {
    this.options = { format: (v) => fixed(v, 2), xFormat: compact, refs: [], bands: [], empty: "No figures yet.", ...options };
    this.now = h("span", { class: "now" });
    this.at = h("span", { class: "at" });
    this.none = h("div", { class: "none" }, this.options.empty);
    this.plot = h("div", { class: ["plot", this.options.height], role: "img", "aria-label": `${options.title}: no figures yet` }, this.none);
    this.element = h("section", { class: "card chart", "data-chart": options.key ?? options.title },
      h("div", { class: "head" }, h("h3", null, options.title, options.unit ? h("span", { class: "unit" }, options.unit) : null),
        options.lines ? h("span", { class: "legend" }, options.lines.map(([, label, token]) => h("span", null, h("i", { style: { background: `var(${token})` } }), label))) : null, this.at, this.now), this.plot);
    this.data = null;
    this.u = null;
    this.pending = 0;
    this.resize = new ResizeObserver(() => this.#fit());
    this.resize.observe(this.plot);
    this.stopTheme = onTheme(() => this.u?.redraw(false, true));
  }

  /** Show columns: x first, then one per series. Drawn at most once per frame. */
  setData(columns) {
    this.data = columns;
    if (!this.pending) this.pending = requestAnimationFrame(() => { this.pending = 0; this.#draw(); });
  }

  destroy() {
    cancelAnimationFrame(this.pending);
    this.resize.disconnect();
    this.stopTheme();
    this.u?.destroy();
    this.u = null;
  }

  #fit() {
    if (!this.u) { if (this.data) this.#draw(); return; }
    const [width, height] = this.#size();
    if (width > 0 && (width !== this.u.width || height !== this.u.height)) this.u.setSize({ width, height });
  }

  #size() {
    const style = getComputedStyle(this.plot);
    return [Math.floor(this.plot.clientWidth - parseFloat(style.paddingLeft) - parseFloat(style.paddingRight)),
      Math.floor(this.plot.clientHeight - parseFloat(style.paddingTop) - parseFloat(style.paddingBottom))];
  }

  #draw() {
    const columns = this.data;
    const any = columns && columns[0].length > 0 && columns.slice(1).some((c) => c.some((v) => v !== null && v !== undefined));
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
      this.u = new uPlot(this.#config(width, height), columns, this.plot);
    } else {
      const { min, max } = this.u.scales.x;
      const zoomed = this.zoomed && min !== null;
      this.u.setData(columns, !zoomed);
      if (zoomed) this.u.setScale("x", { min, max });
    }
    this.#readout(null);
    const last = this.#last();
    this.plot.setAttribute("aria-label", `${this.options.title}: ${columns[0].length} points` + (last ? `, latest ${this.options.format(last.value)} ${this.options.unit ?? ""} at ${this.options.xFormat(last.x)}` : ""));
  }

  #last(index) {
    const main = this.options.series.length;
    const columns = this.data;
    const column = columns[this.options.mainSeries ?? main];
    for (let i = index ?? column.length - 1; i >= 0; i--) {
      if (column[i] !== null && column[i] !== undefined) return { x: columns[0][i], value: column[i] };
      if (index !== undefined && index !== null && index - i > 50) break;
    }
    return null;
  }

  #readout(index) {
    if (this.options.readout === false) return;
    const at = this.#last(index ?? undefined);
    setText(this.now, at ? this.options.format(at.value) : "");
    setText(this.at, at && index !== null && index !== undefined ? this.options.xFormat(at.x) : "");
  }

  #range(u, low, high) {
    const { min, max, refs } = this.options;
    if (low === null || high === null || low === undefined) return [min ?? 0, max ?? 1];
    for (const ref of refs) if (ref.keep !== false) { low = Math.min(low, ref.y); high = Math.max(high, ref.y); }
    if (low === high) { const d = Math.abs(low) * 0.1 || 1; low -= d; high += d; }
    const padding = (high - low) * 0.07;
    return [min !== undefined ? Math.min(min, low) : low - padding, max !== undefined ? Math.max(max, high) : high + padding];
  }

  #config(width, height) {
    const o = this.options;
    const axis = { stroke: () => color("--axis"), font: FONT(), grid: { stroke: () => color("--grid"), width: 1 }, ticks: { show: false }, gap: 6 };
    return {
      width, height, padding: [10, 8, 0, 0], legend: { show: false },
      cursor: { y: false, points: { size: 7, width: 2, stroke: (u, i) => color(o.series[i - 1].token), fill: () => color("--surface") }, drag: { x: true, y: false, setScale: true },
        ...(o.sync ? { sync: { key: o.sync, scales: ["x", null] } } : {}) },
      scales: { x: { time: false }, y: { range: (u, a, b) => this.#range(u, a, b) } },
      axes: [
        { ...axis, size: 26, values: (u, ticks) => ticks.map((v) => o.xFormat(v)) },
        { ...axis, size: o.axisSize ?? 46, space: 34, values: (u, ticks) => ticks.map((v) => (o.axisFormat ?? compact)(v)) },
      ],
      series: [{}, ...o.series.map((line) => ({
        label: line.label, spanGaps: true, width: line.width ?? (line.raw ? 1 : 1.75), dash: line.dash, points: { show: false },
        stroke: () => (line.raw ? faded(line.token, 0.28) : line.token.startsWith("--") ? color(line.token) : line.token), paths: line.hidden ? () => null : undefined,
      }))],
      bands: o.bands.map((band) => ({ series: band.series, fill: () => faded(band.token, 0.15) })),
      hooks: {
        setCursor: [(u) => this.#readout(u.cursor.idx)],
        setScale: [(u, key) => { if (key === "x") this.zoomed = u.data[0].length > 1 && (u.scales.x.min > u.data[0][0] || u.scales.x.max < u.data[0].at(-1)); }],
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
