/** The curves of a job: linked cursors, zoom, smoothing, axes, a choice of charts, and views that are kept by name. */

import { save } from "../api.js";
import { Chart, smooth } from "../charts.js";
import { chartOptions, GROUPS, wallClock, X_AXES } from "../curves.js";
import { fill, h, icon, setText, toast } from "../dom.js";
import { moment } from "../format.js";
import { isEnded } from "../states.js";

const AXES = {
  ...X_AXES,
  clock: { label: "Wall clock", column: (m, events) => wallClock(m, events), format: (v) => moment(v * 1000) },
};

const VIEWS_KEY = "naosprint.curve-views";
const NO_VIEW = { x: "step", weight: 0.6, log: false, hidden: [], ranges: {} };

function readViews() {
  try {
    return JSON.parse(localStorage.getItem(VIEWS_KEY) ?? "{}");
  } catch {
    return {};
  }
}

function writeViews(views) {
  try {
    localStorage.setItem(VIEWS_KEY, JSON.stringify(views));
  } catch {
    toast("The view cannot be saved: the browser refuses storage.", "error");
  }
}

export class CurvesTab {
  constructor(root, store) {
    this.store = store;
    this.view = structuredClone(NO_VIEW);
    this.grid = h("div");
    this.buttons = Object.entries(AXES).map(([key, axis]) =>
      h("button", { "data-x": key, onclick: () => this.change({ x: key }) }, axis.label),
    );
    this.smoothing = h("input", {
      type: "range",
      min: 0,
      max: 0.98,
      step: 0.02,
      "aria-label": "Smoothing",
      oninput: () => {
        this.view.weight = Number(this.smoothing.value);
        this.draw();
      },
    });
    this.log = h("input", {
      type: "checkbox",
      name: "log",
      onchange: () => this.change({ log: this.log.checked }),
    });
    this.picker = h("div", { class: "menu-list chart-list" });
    this.named = h("select", {
      "aria-label": "Saved view",
      onchange: () => this.show({ ...NO_VIEW, ...readViews()[this.named.value] }),
    });
    this.viewName = h("input", { type: "text", placeholder: "Name of the view", "aria-label": "Name of the view" });
    fill(
      root,
      h(
        "div",
        { class: "chart-tools" },
        h("div", { class: "segments", role: "group", "aria-label": "Horizontal axis" }, this.buttons),
        h("label", null, "Smoothing", this.smoothing),
        h("label", null, this.log, "Log scale"),
        h("details", { class: "menu" }, h("summary", { class: "button small" }, "Charts"), this.picker),
        h(
          "details",
          { class: "menu" },
          h("summary", { class: "button small" }, "Views"),
          h(
            "div",
            { class: "menu-list" },
            this.named,
            this.viewName,
            h(
              "div",
              { class: "row" },
              h("button", { class: "small", "data-action": "save-view", onclick: () => this.saveView() }, "Save"),
              h("button", { class: "small danger", onclick: () => this.deleteView() }, "Delete"),
            ),
          ),
        ),
        h("span", { class: "muted hide-tiny" }, "Drag to zoom, double-click to reset"),
        h(
          "button",
          {
            class: "ghost small",
            style: { "margin-left": "auto" },
            onclick: () => save(new Blob([store.metrics.csv()], { type: "text/csv" }), `${store.job.name}-metrics.csv`),
          },
          icon("download"),
          "CSV",
        ),
      ),
      this.grid,
    );
    this.build();
    this.paintViews("");
    this.show(this.view);
    store.on("metrics", () => this.draw());
    store.on("job", () => this.explain());
  }

  /** Make the charts of the task, the algorithm and the columns; a new column may add one. */
  build() {
    const { store } = this;
    const wanted = store.known.charts(store.job.spec, store.metrics.columns.keys());
    const key = wanted.map((c) => c.key).join();
    if (key === this.key) return;
    this.key = key;
    for (const { chart } of this.charts ?? []) chart.destroy();
    const counts = {};
    this.charts = wanted.map((curve) => {
      counts[curve.group] = (counts[curve.group] ?? -1) + 1;
      const options = chartOptions(curve, counts[curve.group]);
      return {
        curve,
        options,
        chart: new Chart({
          ...options,
          sync: `job-${store.id}`,
          mainSeries: options.lines ? 1 : 2,
          xFormat: (v, more) => AXES[this.view.x].format(v, more),
          series: options.lines
            ? options.lines.map(([, label, token]) => ({ label, token }))
            : [
                { label: "raw", token: options.token, raw: true },
                { label: options.title, token: options.token },
              ],
          empty: this.emptyText(),
        }),
      };
    });
    fill(
      this.grid,
      GROUPS.map(([group, label]) => [
        group === "task" ? h("h2", { class: "sr" }, label) : h("div", { class: "section" }, h("h2", null, label)),
        h(
          "div",
          { class: ["charts", group === "task" ? "four" : "three"] },
          this.charts.filter((c) => c.curve.group === group).map((c) => c.chart.element),
        ),
      ]),
    );
    this.applyView();
  }

  emptyText() {
    const { state } = this.store.job;
    if (this.store.metrics.length) return isEnded(state) ? "The training has no such values." : "No values yet.";
    if (state === "queued") return "The job waits in the queue. Metrics appear after the first update.";
    if (isEnded(state)) return "This job ended before its first update.";
    return "Metrics appear after the first update.";
  }

  /** Say in charts that are empty why they are. */
  explain() {
    for (const { chart } of this.charts) setText(chart.none, this.emptyText());
  }

  /** Change some settings of what is shown. */
  change(settings) {
    this.show({ ...this.view, ...settings });
  }

  /** Show the charts with other settings. */
  show(view) {
    if (view.x !== this.view.x) this.charts[0]?.chart.zoom(null);
    this.view = structuredClone(view);
    this.smoothing.value = String(view.weight);
    this.log.checked = view.log;
    Object.keys(AXES).forEach((key, i) => this.buttons[i].setAttribute("aria-pressed", String(key === view.x)));
    this.applyView();
    this.draw();
  }

  applyView() {
    for (const { curve, chart } of this.charts) {
      chart.element.hidden = this.view.hidden.includes(curve.key);
      chart.setVertical({ log: this.view.log, range: this.view.ranges[curve.key] ?? [null, null] });
    }
    this.paintPicker();
  }

  /** The list of charts: which are shown, and between which values. */
  paintPicker() {
    fill(
      this.picker,
      this.charts.map(({ curve }) => {
        const box = h("input", {
          type: "checkbox",
          name: `show:${curve.key}`,
          checked: !this.view.hidden.includes(curve.key),
          onchange: () => {
            const others = this.view.hidden.filter((key) => key !== curve.key);
            this.change({ hidden: box.checked ? others : [...others, curve.key] });
          },
        });
        const [low, high] = this.view.ranges[curve.key] ?? [null, null];
        const end = (label, value) =>
          h("input", {
            type: "number",
            step: "any",
            placeholder: label,
            "aria-label": `${curve.title}: ${label} of the vertical axis`,
            name: `${label}:${curve.key}`,
            value: value ?? "",
            onchange: () => this.setRange(curve.key, from.value, to.value),
          });
        const from = end("min", low);
        const to = end("max", high);
        return h("div", { class: "row" }, h("label", { class: "row grow" }, box, curve.title), from, to);
      }),
    );
  }

  setRange(key, low, high) {
    const number = (text) => (text.trim() === "" || Number.isNaN(Number(text)) ? null : Number(text));
    this.change({ ranges: { ...this.view.ranges, [key]: [number(low), number(high)] } });
  }

  paintViews(chosen) {
    const names = Object.keys(readViews()).sort();
    fill(
      this.named,
      h("option", { value: "" }, "Default view"),
      names.map((name) => h("option", { value: name }, name)),
    );
    this.named.value = chosen;
  }

  saveView() {
    const name = this.viewName.value.trim() || this.named.value;
    if (!name) {
      toast("Give the view a name first.", "error");
      return;
    }
    writeViews({ ...readViews(), [name]: this.view });
    this.viewName.value = "";
    this.paintViews(name);
    toast(`View ${name} was saved in this browser.`);
  }

  deleteView() {
    const { [this.named.value]: _, ...others } = readViews();
    writeViews(others);
    this.paintViews("");
    this.show(NO_VIEW);
  }

  draw() {
    if (this.gone) return;
    this.build();
    this.explain();
    const m = this.store.metrics;
    const x = AXES[this.view.x].column(m, this.store.events);
    for (const { curve, options, chart } of this.charts) {
      chart.setData(() => {
        const lines = curve.metrics.map(({ name }) => m.get(name));
        const smoothed = lines.map((y) => smooth(y, this.view.weight));
        return options.lines ? [x, ...smoothed] : [x, ...lines, ...smoothed];
      });
    }
  }

  destroy() {
    this.gone = true;
    for (const { chart } of this.charts) chart.destroy();
  }
}
