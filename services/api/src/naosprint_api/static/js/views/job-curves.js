/** The curves of a job: linked cursors, zoom by dragging, smoothing, steps or time. */

import { save } from "../api.js";
import { Chart, smooth } from "../charts.js";
import { chartOptions, GROUPS, X_AXES } from "../curves.js";
import { fill, h, icon } from "../dom.js";
import { isEnded } from "../states.js";

export class CurvesTab {
  constructor(root, store) {
    this.store = store;
    this.x = "step";
    this.weight = 0.6;
    this.grid = h("div");
    this.buttons = Object.entries(X_AXES).map(([key, axis]) =>
      h("button", { "aria-pressed": String(key === this.x), onclick: () => this.setX(key) }, axis.label),
    );
    const range = h("input", {
      type: "range",
      min: 0,
      max: 0.98,
      step: 0.02,
      value: this.weight,
      "aria-label": "Smoothing",
      oninput: () => {
        this.weight = Number(range.value);
        this.draw();
      },
    });
    fill(
      root,
      h(
        "div",
        { class: "chart-tools" },
        h("div", { class: "segments", role: "group", "aria-label": "Horizontal axis" }, this.buttons),
        h("label", null, "Smoothing", range),
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
    store.on("metrics", () => this.draw());
    store.on("job", () => {
      for (const { chart } of this.charts) if (!store.metrics.length) chart.none.textContent = this.emptyText();
    });
    this.draw();
  }

  /** Make the charts that the task, the algorithm and the columns ask for; a new column may ask for another one. */
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
          xFormat: (v) => X_AXES[this.x].format(v),
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
  }

  emptyText() {
    const { state } = this.store.job;
    if (state === "queued") return "Waiting for a worker. Metrics appear after the first update.";
    if (isEnded(state)) return "This job ended before its first update.";
    return "Metrics appear after the first update.";
  }

  setX(key) {
    this.x = key;
    Object.keys(X_AXES).forEach((k, i) => this.buttons[i].setAttribute("aria-pressed", String(k === key)));
    this.charts[0].chart.zoom(null);
    this.draw();
  }

  draw() {
    if (this.gone) return;
    this.build();
    const m = this.store.metrics;
    const axis = X_AXES[this.x];
    for (const { curve, options, chart } of this.charts) {
      chart.setData(() => {
        const lines = curve.metrics.map(({ name }) => m.get(name));
        const smoothed = lines.map((y) => smooth(y, this.weight));
        return options.lines ? [axis.column(m), ...smoothed] : [axis.column(m), ...lines, ...smoothed];
      });
    }
  }

  destroy() {
    this.gone = true;
    for (const { chart } of this.charts) chart.destroy();
  }
}
