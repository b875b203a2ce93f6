/** Plots of a set of jobs: any setting, result or metric against another, or several as parallel coordinates. */

import { PALETTE } from "../charts.js";
import { fill, h, icon, scroller } from "../dom.js";
import { Figure } from "../figures.js";
import { integer, titled, words } from "../format.js";
import { namesOf, valueIn } from "../jobs.js";
import { axisOf, metricAxis, missing, parallel, scatter } from "../plots.js";

/** Most axes that are chosen at first, besides the result. */
const FIRST_AXES = 4;
/** Fields of a job that are axes, besides settings, results and metrics. */
const FIELDS = ["progress_step", "owner", "state"];

/** What the address says of a plot. */
export const PLOT_KEYS = ["plot", "x", "y", "color", "axes"];

const distinct = (jobs, name) => new Set(jobs.map((job) => JSON.stringify(valueIn(job, name))));
const last = (name) => name.split(".").at(-1);

/** Names of what the jobs have, by kind, those that tell them apart first. */
function offered(jobs, metrics) {
  const names = namesOf(jobs).filter((name) => jobs.some((job) => !missing(valueIn(job, name))));
  const results = new Set(jobs.flatMap((job) => (job.result?.results ?? []).map((result) => result.name)));
  const live = new Set(jobs.flatMap((job) => Object.keys(job.latest_metrics ?? {})));
  const settings = names.filter((name) => !results.has(name) && !live.has(name));
  // those that most jobs have, with the most values, tell most
  const has = new Map(names.map((name) => [name, jobs.filter((job) => !missing(valueIn(job, name))).length]));
  const common = (a, b) => has.get(b) - has.get(a);
  const values = new Map(settings.map((name) => [name, distinct(jobs, name).size]));
  const differing = settings
    .filter((name) => values.get(name) > 1)
    .sort((a, b) => common(a, b) || values.get(b) - values.get(a));
  return {
    Results: [...results].filter((name) => names.includes(name) && metrics.has(name)).sort(common),
    "Settings that differ": differing,
    Metrics: names.filter((name) => live.has(name) && !results.has(name)),
    Job: FIELDS,
    "Other settings": settings.filter((name) => !differing.includes(name)),
  };
}

/** Descriptions of the results and metrics of the jobs by name. */
function described(jobs, known) {
  const found = new Map();
  for (const job of jobs) {
    for (const [name, metric] of known.metrics(job.spec)) found.set(name, metric);
    for (const result of job.result?.results ?? []) found.set(result.name, result);
  }
  return found;
}

export class JobPlots {
  /**
   * @param {object} known descriptions of tasks and robots
   * @param {Record<string, string>} state what the address says, by `PLOT_KEYS`
   * @param {(change: Record<string, string>) => void} onChange called with what the user has chosen
   */
  constructor(known, state, onChange) {
    this.known = known;
    this.state = state;
    this.onChange = onChange;
    this.jobs = [];
    this.tools = h("div", { class: "plot-tools" });
    this.note = h("p", { class: "muted", role: "status" });
    this.figure = new Figure((width) => this.draw(width));
    this.element = h(
      "section",
      { class: "card", "data-part": "plots", style: { "margin-bottom": "1.14rem" } },
      this.tools,
      h("div", { class: "pad stack" }, scroller("Plot", this.figure.element), this.note),
    );
  }

  destroy() {
    this.figure.destroy();
    this.element.remove();
  }

  /** Show these jobs, as the address says. */
  update(jobs, state = this.state) {
    this.jobs = jobs;
    this.state = state;
    this.metrics = described(jobs, this.known);
    this.offered = offered(jobs, this.metrics);
    this.paintTools();
    this.figure.redraw();
  }

  /** What is shown: what was chosen, else what tells the jobs apart. */
  chosen() {
    const { state } = this;
    const settings = this.offered["Settings that differ"].filter((name) => name !== "seed");
    const goal = this.offered.Results[0] ?? this.offered.Metrics.find((name) => this.isListed(name)) ?? "progress_step";
    const first = settings.find((name) => this.jobs.some((job) => typeof valueIn(job, name) === "number"));
    return {
      plot: state.plot === "parallel" ? "parallel" : "scatter",
      x: state.x || (first ?? settings[0] ?? "seed"),
      y: state.y || goal,
      color: state.color ?? "",
      axes: state.axes ? state.axes.split(",") : [...settings.slice(0, FIRST_AXES), goal],
    };
  }

  isListed(name) {
    return this.jobs.some((job) => this.known.listed(job.spec).some((metric) => metric.name === name));
  }

  titleOf(name) {
    const metric = this.metrics.get(name);
    if (metric) return titled(metric);
    return FIELDS.includes(name) ? words(name) : last(name);
  }

  axis(name) {
    const metric = this.metrics.get(name);
    const values = this.jobs.map((job) => valueIn(job, name));
    return metric ? metricAxis(metric, values) : axisOf(this.titleOf(name), values);
  }

  /** The colors of the values of a setting; null for one color. */
  colors(name) {
    if (!name) return null;
    const values = [...new Set(this.jobs.map((job) => String(valueIn(job, name) ?? "none")))].sort();
    return new Map(values.map((value, i) => [value, PALETTE[i % PALETTE.length]]));
  }

  draw(width) {
    const { plot, x, y, color, axes } = this.chosen();
    const names = plot === "parallel" ? axes : [x, y];
    const columns = names.map((name) => this.axis(name));
    const colors = this.colors(color);
    const rows = this.jobs.map((job) => {
      const values = names.map((name) => valueIn(job, name));
      const texts = columns.map(({ title, format }, i) => `${title} ${missing(values[i]) ? "–" : format(values[i])}`);
      return {
        label: `${job.name}: ${texts.join(", ")}`,
        href: `#/jobs/${job.id}`,
        token: colors?.get(String(valueIn(job, color) ?? "none")),
        values,
      };
    });
    const whole = rows.filter(({ values }) => !values.some(missing)).length;
    this.note.textContent =
      whole === rows.length
        ? ""
        : `${integer(rows.length - whole)} of ${integer(rows.length)} jobs do not have all of these values.`;
    const label = `${columns.map(({ title }) => title).join(" and ")} of ${integer(rows.length)} jobs`;
    return (plot === "parallel" ? parallel : scatter)(width, columns, rows, label);
  }

  /** A control that offers all names. */
  select(label, value, first, onchange) {
    const option = (name) => h("option", { value: name }, this.metrics.has(name) ? this.titleOf(name) : name);
    const control = h(
      "select",
      { "aria-label": label, onchange: () => onchange(control.value) },
      first === null ? null : h("option", { value: "" }, first),
      Object.entries(this.offered)
        .filter(([, names]) => names.length)
        .map(([title, names]) => h("optgroup", { label: title }, names.map(option))),
    );
    control.value = value;
    return control;
  }

  paintTools() {
    const { plot, x, y, color, axes } = this.chosen();
    const key = JSON.stringify([plot, x, y, color, axes, this.offered]);
    if (key === this.painted) return;
    this.painted = key;
    const kind = (value, title) =>
      h("button", { "aria-pressed": String(plot === value), onclick: () => this.onChange({ plot: value }) }, title);
    const setAxes = (names) => this.onChange({ axes: names.join(",") });
    const removable = (name) =>
      h(
        "button",
        {
          class: "small",
          "aria-label": `Remove axis ${name}`,
          disabled: axes.length < 3,
          onclick: () => setAxes(axes.filter((other) => other !== name)),
        },
        this.titleOf(name),
        icon("close"),
      );
    fill(
      this.tools,
      h(
        "div",
        { class: "segments", role: "group", "aria-label": "Kind of plot" },
        kind("scatter", "Scatter"),
        kind("parallel", "Parallel coordinates"),
      ),
      plot === "scatter"
        ? [
            h(
              "label",
              null,
              "Horizontal",
              this.select("Horizontal axis", x, null, (name) => this.onChange({ x: name })),
            ),
            h(
              "label",
              null,
              "Vertical",
              this.select("Vertical axis", y, null, (name) => this.onChange({ y: name })),
            ),
          ]
        : [
            axes.map(removable),
            this.select("Add an axis", "", "Add an axis", (name) => name && setAxes([...new Set([...axes, name])])),
          ],
      h(
        "label",
        null,
        "Color",
        this.select("Color by", color, "one", (name) => this.onChange({ color: name })),
      ),
      this.legend(color),
    );
  }

  legend(color) {
    const colors = this.colors(color);
    if (!colors) return null;
    const entry = ([value, token]) => h("span", null, h("i", { style: { background: `var(${token})` } }), value);
    return h("div", { class: "legend" }, [...colors].slice(0, PALETTE.length).map(entry));
  }
}
