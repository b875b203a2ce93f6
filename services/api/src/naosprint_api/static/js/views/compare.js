/** Comparison of jobs: curves, groups with mean and band, results of their evaluations. */

import { call, every, query, save } from "../api.js";
import { Chart, PALETTE, smooth } from "../charts.js";
import { Columns } from "../columns.js";
import { chartOptions, GROUPS, X_AXES } from "../curves.js";
import { common, descriptions, nameOf } from "../descriptions.js";
import { fill, h, heading, icon, scroller, table, toast } from "../dom.js";
import { headline, meanProfile, profile, representative } from "../evaluation.js";
import { Figure, resultLines } from "../figures.js";
import { compact, csv, integer, metricText, shownUnit, withUnit } from "../format.js";
import { latest, newer, progress, summary } from "../jobs.js";
import { isEnded, stateBadge, stateNote } from "../states.js";
import { follow } from "../stream.js";
import { color, onTheme } from "../theme.js";
import { JobPlots } from "./job-plots.js";
import { loading, notice } from "./messages.js";
import { axisOf } from "./results.js";
import { flattened, knowledge, show } from "./spec-list.js";

const MAX_JOBS = 32;
const GRID = 400;
/**
 * Most points of all lines together that are joined to one axis. Beyond that, lines are drawn on a common grid: joined,
 * each would have a gap at every point of the others.
 */
const MAX_JOINED = 6000;
const FINE_GRID = 1200;
const DASHES = [undefined, [6, 4], [2, 3], [10, 4, 2, 4]];

const USUAL_AXIS = "step";
const USUAL_SMOOTHING = 0.6;
const MOST_SMOOTHING = 0.98;

/** Most columns of metrics, and of results, in the table. */
const MOST_METRICS = 3;
const MOST_RESULTS = 4;

/** What "group by" can do: the label that jobs of one group share. */
const GROUPINGS = {
  none: ["Each job", null],
  settings: ["All but the seed", (job) => summary(job) + differing(job)],
  preset: ["Preset", (job) => job.spec.algorithm?.preset ?? "none"],
  task: ["Task", (job) => nameOf(job.spec, "task")],
  robot: ["Robot", (job) => nameOf(job.spec, "robot")],
  simulator: ["Simulator", (job) => nameOf(job.spec, "simulator")],
  tag: ["First tag", (job) => job.tags[0] ?? "no tag"],
  group: ["Sweep", (job) => job.group_id ?? "single"],
};

/** The jobs that an address asks for. */
const askedBy = (params) => `${params.get("group")} ${params.get("jobs")}`;

/** The grouping that an address asks for; a sweep's jobs differ in what was swept. */
const groupingOf = (params) =>
  Object.hasOwn(GROUPINGS, params.get("by")) ? params.get("by") : params.get("group") ? "settings" : "none";

/** The smoothing that an address asks for. */
const smoothingOf = (params) => {
  const asked = Number(params.get("smoothing") ?? NaN);
  return asked >= 0 && asked <= MOST_SMOOTHING ? asked : USUAL_SMOOTHING;
};

/** The horizontal axis that an address asks for. */
const axisAsked = (params) => (Object.hasOwn(X_AXES, params.get("x")) ? params.get("x") : USUAL_AXIS);

/** Paths that every list of jobs shows anyway. */
const SHOWN = new Set(["seed", "task.name", "robot.name", "simulator.name", "algorithm.preset"]);
/** Most settings of a job in its row of the table; more are in the table of settings only. */
const MOST_SETTINGS = 4;
let varying = [];
/** Settings by path of each job, by id, with the defaults of those that an older version did not store. */
const settings = new Map();
const differing = (job, most = Infinity) => {
  const values = settings.get(job.id) ?? {};
  const own = varying.filter((k) => k in values);
  if (own.length > most) return "";
  return own.map((k) => ` · ${k.split(".").at(-1)} ${show(values[k])}`).join("");
};

/** Read a curve at `x` by linear interpolation; null outside of it. */
function interpolate(xs, ys, x) {
  let low = 0;
  let high = xs.length - 1;
  if (high < 0 || x < xs[0] || x > xs[high]) return null;
  while (high - low > 1) {
    const mid = (low + high) >> 1;
    if (xs[mid] <= x) low = mid;
    else high = mid;
  }
  const a = ys[low];
  const b = ys[high];
  if (a === null || b === null || xs[high] === xs[low]) return b ?? a;
  return a + ((b - a) * (x - xs[low])) / (xs[high] - xs[low]);
}

/**
 * Mean and standard deviation of several curves on a common grid, where more than half of them have a value. The band
 * ends at 0 and at `most` if no value is beyond.
 */
export function band(curves, grid, most = Infinity) {
  const mean = [];
  const low = [];
  const high = [];
  for (const x of grid) {
    const values = curves.map(([xs, ys]) => interpolate(xs, ys, x)).filter((v) => v !== null);
    if (values.length * 2 <= curves.length) {
      mean.push(null);
      low.push(null);
      high.push(null);
      continue;
    }
    const m = values.reduce((a, b) => a + b, 0) / values.length;
    const sd = values.length > 1 ? Math.sqrt(values.reduce((a, b) => a + (b - m) ** 2, 0) / (values.length - 1)) : 0;
    mean.push(m);
    low.push(Math.max(m - sd, Math.min(...values) < 0 ? -Infinity : 0));
    high.push(Math.min(m + sd, Math.max(...values) > most ? Infinity : most));
  }
  return { mean, low, high };
}

/** Drop the x and y where y is missing. */
function dense(xs, ys) {
  const x = [];
  const y = [];
  for (let i = 0; i < xs.length; i++)
    if (ys[i] !== null && ys[i] !== undefined && xs[i] !== null) {
      x.push(xs[i]);
      y.push(ys[i]);
    }
  return [x, y];
}

class CompareView {
  constructor(root, { params, signal, go }) {
    this.root = root;
    this.signal = signal;
    this.go = go;
    this.asked = askedBy(params);
    this.group = params.get("group");
    this.ids = [...new Set((params.get("jobs") ?? "").split(",").filter(Boolean))];
    this.by = groupingOf(params);
    this.x = axisAsked(params);
    this.weight = smoothingOf(params);
    this.items = [];
    this.charts = [];
  }

  async start() {
    document.title = "Compare · naosprint";
    fill(this.root, h("div", { class: "card" }, loading("Loading jobs")));
    if (this.group)
      this.ids = (await every("jobs", { params: { group: this.group }, signal: this.signal }))
        .map((j) => j.id)
        .toReversed();
    const missing = [];
    this.known = await descriptions();
    this.knowledge = await knowledge(this.signal);
    await Promise.all(
      this.ids.slice(0, MAX_JOBS).map(async (id, i) => {
        try {
          this.items[i] = await this.item(id);
        } catch (error) {
          if (error.name === "AbortError") throw error;
          missing.push(`${id}: ${error.message}`);
        }
      }),
    );
    this.items = this.items.filter(Boolean);
    this.missing = missing;
    if (this.ids.length > MAX_JOBS)
      this.missing.push(`Only the first ${MAX_JOBS} of ${this.ids.length} jobs are shown.`);
    this.build();
    follow("jobs/stream", {
      signal: this.signal,
      onEvent: (type, job) => {
        if (type === "job") this.onJob(job);
        if (type === "gone") this.onGone(job.id);
        if (type === "ready" || type === "reset") this.reread();
      },
    });
    this.stopTheme = onTheme(() => this.paintTable());
  }

  /** The address changes with what is chosen on the page; other jobs need another view. */
  update({ params }) {
    const chosen =
      groupingOf(params) === this.by && axisAsked(params) === this.x && smoothingOf(params) === this.weight;
    return this.items.length > 0 && askedBy(params) === this.asked && chosen;
  }

  /** Read all jobs again, and metrics that are missing: changes from before `ready` or `reset` were not sent. */
  reread() {
    for (const { job, metrics } of this.items) {
      const path = `jobs/${encodeURIComponent(job.id)}`;
      const read = async () => {
        const changed = await call(path, { signal: this.signal });
        if (latest(changed).step !== metrics.step.at(-1)) metrics.load(await this.metrics(path));
        this.onJob(changed);
      };
      read().catch((error) => error.status === 404 && this.onGone(job.id));
    }
  }

  /** Leave out a job that was deleted. */
  onGone(id) {
    const item = this.items.find((each) => each.job.id === id);
    if (!item) return;
    toast(`${item.job.name} was deleted.`);
    this.remove(id, { replace: true });
  }

  async item(id) {
    const path = `jobs/${encodeURIComponent(id)}`;
    const [job, columns, evaluation] = await Promise.all([
      call(path, { signal: this.signal }),
      this.metrics(path),
      this.evaluation(id),
    ]);
    const metrics = new Columns();
    metrics.load(columns);
    return { job, metrics, evaluation };
  }

  /** Columns of a job's metrics. */
  async metrics(path) {
    return (await call(`${path}/metrics${query({ max_points: 1500 })}`, { signal: this.signal })).columns;
  }

  /** Evaluation that is shown for a job; null without one. */
  async evaluation(id) {
    return representative(await every(`jobs/${encodeURIComponent(id)}/evaluations`, { signal: this.signal }));
  }

  destroy() {
    for (const { chart } of this.charts) chart.destroy();
    this.figure?.destroy();
    this.plots?.destroy();
    clearTimeout(this.refresh);
    this.stopTheme?.();
  }

  build() {
    settings.clear();
    for (const { job } of this.items) {
      const defaults = [...this.knowledge.training(job.spec)].filter(([, f]) => f.fallback !== undefined);
      const missing = Object.fromEntries(defaults.map(([path, f]) => [path, f.fallback]));
      settings.set(job.id, { ...missing, ...flattened(job.spec) });
    }
    const specs = [...settings.values()];
    const paths = new Set(specs.flatMap((values) => Object.keys(values)));
    varying = [...paths].filter(
      (k) =>
        !SHOWN.has(k) && !k.endsWith(".version") && new Set(specs.map((values) => JSON.stringify(values[k]))).size > 1,
    );
    this.picker = h("input", {
      type: "search",
      placeholder: "Add a job by name or id",
      "aria-label": "Add a job",
      list: "compare-found",
      autocomplete: "off",
      oninput: () => this.suggest(),
      onchange: () => this.add(this.picker.value),
    });
    this.found = h("datalist", { id: "compare-found" });
    const head = h(
      "div",
      { class: "page-head" },
      h("h1", { class: "grow" }, "Compare"),
      h(
        "div",
        { class: "filters", style: { margin: 0 } },
        h("div", { class: "search" }, icon("search"), this.picker, this.found),
      ),
    );
    if (!this.items.length) {
      fill(
        this.root,
        head,
        this.missing.map((m) => notice("warn", "", m)),
        h(
          "div",
          { class: "card empty" },
          h("h2", null, "Nothing to compare yet"),
          h("p", null, "Select jobs in the list and press Compare, or add them here by name."),
          h("div", { class: "row" }, h("a", { class: "button primary", href: "#/" }, "Choose jobs")),
        ),
      );
      return;
    }
    const grouping = h(
      "select",
      {
        "aria-label": "Group by",
        style: { width: "auto" },
        onchange: () => {
          this.by = grouping.value;
          this.open(this.ids, { replace: true });
          this.rebuildCharts();
        },
      },
      Object.entries(GROUPINGS).map(([key, [label]]) => h("option", { value: key }, label)),
    );
    grouping.value = this.by;
    this.buttons = Object.entries(X_AXES).map(([key, axis]) =>
      h(
        "button",
        {
          "aria-pressed": String(key === this.x),
          onclick: () => {
            this.x = key;
            Object.keys(X_AXES).forEach((k, i) => this.buttons[i].setAttribute("aria-pressed", String(k === key)));
            this.charts[0]?.chart.zoom(null);
            this.draw();
            this.open(this.ids, { replace: true });
          },
        },
        axis.label,
      ),
    );
    const range = h("input", {
      type: "range",
      min: 0,
      max: MOST_SMOOTHING,
      step: 0.02,
      value: this.weight,
      "aria-label": "Smoothing",
      oninput: () => {
        this.weight = Number(range.value);
        this.draw();
      },
      onchange: () => this.open(this.ids, { replace: true }),
    });
    this.legend = h("div", { class: "legend" });
    this.grid = h("div", { class: "charts" });
    this.rows = scroller("Jobs compared");
    this.evaluated = h("div", { class: "stack" });
    this.pick = h("div", { class: "segments", role: "group", "aria-label": "Results" });
    this.figure = new Figure((width) => resultLines(width, this.series, this.axis));
    this.numbers = scroller("Results compared");
    this.plots?.destroy();
    this.plots = new JobPlots(this.known, {}, (change) =>
      this.plots.update(this.plotted(), { ...this.plots.state, ...change }),
    );
    fill(
      this.root,
      head,
      this.missing.map((m) => notice("warn", "", m)),
      h("section", { class: "card", style: { "margin-bottom": "1.14rem" } }, this.rows),
      this.settingsTable(),
      h(
        "div",
        { class: "chart-tools" },
        h("label", null, "Group by", grouping),
        h("div", { class: "segments", role: "group", "aria-label": "Horizontal axis" }, this.buttons),
        h("label", null, "Smoothing", range),
        h(
          "button",
          { class: "ghost small", style: { "margin-left": "auto" }, onclick: () => this.csv() },
          icon("download"),
          "CSV",
        ),
      ),
      this.legend,
      h("div", { style: { height: "0.86rem" } }),
      this.evaluated,
      this.grid,
      this.items.length > 1 ? [h("div", { style: { height: "1.14rem" } }), this.plots.element] : null,
    );
    this.plots.update(this.plotted());
    this.rebuildCharts();
  }

  /** The jobs with all results of their evaluations, for plots. */
  plotted() {
    return this.items.map(({ job, evaluation }) => {
      const results = evaluation?.summary?.results && this.known.results(evaluation.summary);
      return results ? { ...job, result: { ...job.result, results } } : job;
    });
  }

  /** The settings that differ, folded; a job that does not have a setting has none of its own. */
  settingsTable() {
    if (!varying.length) return null;
    const cells = (k) => this.items.map(({ job }) => settings.get(job.id)).map((s) => (k in s ? show(s[k]) : "–"));
    return h(
      "details",
      { class: "card", style: { "margin-bottom": "1.14rem" }, "data-part": "settings" },
      h("summary", null, `${varying.length} settings differ`),
      scroller(
        "Settings that differ",
        h(
          "table",
          { class: "plain" },
          h(
            "thead",
            null,
            h(
              "tr",
              null,
              h("th", { scope: "col" }, "Setting"),
              this.items.map(({ job }) => h("th", { scope: "col", class: "num" }, job.name)),
            ),
          ),
          h(
            "tbody",
            null,
            varying.map((k) =>
              h(
                "tr",
                null,
                h("th", { scope: "row" }, h("code", null, k)),
                cells(k).map((text) => h("td", { class: "num" }, text)),
              ),
            ),
          ),
        ),
      ),
    );
  }

  /** Jobs by group label, in order of first appearance. */
  groups() {
    const of = GROUPINGS[this.by][1];
    const map = new Map();
    for (const item of this.items) {
      const label = of ? of(item.job) : item.job.id;
      if (!map.has(label)) map.set(label, []);
      map.get(label).push(item);
    }
    return [...map].map(([label, items], i) => ({
      label: of ? label : items[0].job.name,
      items,
      token: PALETTE[i % PALETTE.length],
      dash: DASHES[Math.floor(i / PALETTE.length) % DASHES.length],
    }));
  }

  /**
   * One chart for each metric, with the jobs that have it. What has no unit, such as the reward or a loss, is on a
   * scale of its task: several tasks have a chart each.
   */
  wanted() {
    const charts = new Map();
    const several = new Set(this.items.map(({ job }) => nameOf(job.spec, "task"))).size > 1;
    for (const item of this.items)
      for (const c of this.known.charts(item.job.spec, item.metrics.columns.keys()))
        for (const metric of c.metrics) {
          const task = several && c.group !== "pace" && !metric.unit ? ` · ${nameOf(item.job.spec, "task")}` : "";
          const refs = c.refs.filter((ref) => ref.metric === metric.name);
          const key = [metric.name, metric.title, metric.unit].join() + task;
          const title = (c.metrics.length > 1 ? metric.title : c.title) + task;
          const found = charts.get(key) ?? {
            key: metric.name + task,
            group: c.group,
            title,
            metrics: [metric],
            refs,
            items: [],
          };
          // a reference is drawn if it is one of all jobs: robots and tasks have different ones
          found.refs = found.refs.filter(({ label }) => refs.some((ref) => ref.label === label));
          found.items.push(item);
          charts.set(key, found);
        }
    const order = GROUPS.map(([group]) => group);
    return [...charts.values()]
      .filter((c) => c.group === "task" || c.items.some(({ metrics }) => metrics.has(c.metrics[0].name)))
      .sort((a, b) => order.indexOf(a.group) - order.indexOf(b.group));
  }

  rebuildCharts() {
    for (const { chart } of this.charts) chart.destroy();
    const groups = this.groups();
    const banded = this.by !== "none";
    this.charts = this.wanted().map((curve) => ({
      curve,
      chart: new Chart({
        ...chartOptions(curve),
        sync: "compare",
        readout: false,
        xFormat: (v, more) => X_AXES[this.x].format(v, more),
        series: groups.flatMap((g) =>
          banded
            ? [
                { label: `${g.label} high`, token: g.token, hidden: true },
                { label: `${g.label} low`, token: g.token, hidden: true },
                { label: g.label, token: g.token, dash: g.dash, width: 2 },
              ]
            : [{ label: g.label, token: g.token, dash: g.dash }],
        ),
        bands: banded ? groups.map((g, i) => ({ series: [3 * i + 1, 3 * i + 2], token: g.token })) : [],
      }),
    }));
    fill(
      this.grid,
      this.charts.map((c) => c.chart.element),
    );
    this.paintTable();
    this.paintEvaluations();
    this.draw();
  }

  paintTable() {
    if (!this.rows) return;
    const groups = this.groups();
    const banded = this.by !== "none";
    const swatch = (g) => h("span", { class: "swatch", style: { background: color(g.token) } });
    fill(
      this.legend,
      groups.map((g) => h("span", null, swatch(g), banded ? `${g.label} (${g.items.length})` : g.label)),
      banded ? h("span", { class: "muted" }, "Line: mean. Band: one standard deviation.") : null,
    );
    const metrics = common(this.items.map(({ job }) => this.known.listed(job.spec))).slice(0, MOST_METRICS);
    const results = common(this.items.map(({ evaluation }) => headline(evaluation?.summary))).slice(0, MOST_RESULTS);
    const cells = (item) => {
      const m = latest(item.job);
      const own = this.known.metrics(item.job.spec);
      const found = new Map((item.evaluation?.summary?.results ?? []).map((r) => [r.name, r]));
      return [
        compact(item.job.progress_step),
        ...metrics.map(({ name }) => (own.has(name) ? metricText(own.get(name), m[name]) : "–")),
        integer(m.steps_per_s),
        ...(results.length ? [integer(item.evaluation?.summary?.episodes)] : []),
        ...results.map(({ name }) => (found.has(name) ? metricText(found.get(name), found.get(name).value) : "–")),
      ];
    };
    const titled = (m) => [m.title, shownUnit(m)].filter(Boolean).join(" ");
    const row = (g, item) =>
      h(
        "tr",
        { "data-job": item.job.id },
        h(
          "td",
          { class: "compare-name" },
          h(
            "div",
            { class: "row" },
            swatch(g),
            h(
              "div",
              null,
              h("a", { href: `#/jobs/${item.job.id}` }, item.job.name),
              h(
                "div",
                { class: "muted" },
                summary(item.job),
                ` · seed ${item.job.spec.seed}`,
                differing(item.job, MOST_SETTINGS),
              ),
            ),
          ),
        ),
        h(
          "td",
          null,
          stateBadge(
            item.job.state,
            stateNote(item.job) ?? (isEnded(item.job.state) ? undefined : `${Math.floor(progress(item.job) * 100)} %`),
          ),
        ),
        cells(item).map((c) => h("td", { class: "num" }, c)),
        h(
          "td",
          { class: "num" },
          h(
            "button",
            {
              class: "ghost square",
              "aria-label": `Remove ${item.job.name} from the comparison`,
              onclick: () => this.remove(item.job.id),
            },
            icon("close"),
          ),
        ),
      );
    fill(
      this.rows,
      h(
        "table",
        null,
        h(
          "thead",
          null,
          h(
            "tr",
            null,
            h("th", { rowspan: 2, scope: "col" }, "Job"),
            h("th", { rowspan: 2, scope: "col" }, "State"),
            h(
              "th",
              { colspan: metrics.length + 2, scope: "colgroup", class: "group" },
              "Training, latest episodes with exploration",
            ),
            results.length
              ? h("th", { colspan: results.length + 1, scope: "colgroup", class: "group" }, "Evaluation")
              : null,
            h("th", { rowspan: 2 }, h("span", { class: "sr" }, "Remove")),
          ),
          h(
            "tr",
            null,
            [
              "Steps",
              ...metrics.map(titled),
              "Steps/s",
              ...(results.length ? ["Episodes"] : []),
              ...results.map(titled),
            ].map((title) => heading(title, true)),
          ),
        ),
        h(
          "tbody",
          null,
          groups.flatMap((g) => g.items.map((item) => row(g, item))),
        ),
      ),
    );
  }

  /** Tables of results of the evaluations, by name, each with the columns that some job has. */
  tables() {
    const tables = new Map();
    for (const { evaluation } of this.items) {
      for (const table of evaluation?.summary?.tables ?? []) {
        if (!tables.has(table.name)) tables.set(table.name, { table, columns: new Set() });
        for (const column of table.columns) tables.get(table.name).columns.add(column.title);
      }
    }
    return tables;
  }

  /** One column of a table of results, of the groups that have evaluations, over each other. */
  paintEvaluations() {
    const options = [...this.tables().values()].flatMap(({ table, columns }) =>
      [...columns].map((column) => ({ table, column, key: `${table.name} ${column}` })),
    );
    if (!options.length) {
      this.evaluated.replaceChildren();
      return;
    }
    const chosen = options.find((o) => o.key === this.chosen) ?? options[0];
    const several = new Set(options.map((o) => o.table.name)).size > 1;
    fill(
      this.pick,
      options.map((o) =>
        h(
          "button",
          {
            "data-value": o.key,
            "aria-pressed": String(o === chosen),
            onclick: () => {
              this.chosen = o.key;
              this.paintEvaluations();
            },
          },
          several ? `${o.table.title}: ${o.column}` : o.column,
        ),
      ),
    );
    const of = (g) =>
      g.items
        .map((i) => i.evaluation?.summary?.tables?.find((t) => t.name === chosen.table.name))
        .filter(Boolean)
        .map((t) => profile(t, chosen.column))
        .filter((rows) => rows.length);
    const groups = this.groups()
      .map((g) => ({ ...g, profiles: of(g) }))
      .filter((g) => g.profiles.length);
    const { axis } = chosen.table;
    this.axis = axisOf(chosen.table);
    this.series = groups.map((g) => ({
      label: g.label,
      token: g.token,
      dash: g.dash?.join(" "),
      rows: meanProfile(g.profiles),
      count: g.profiles.length,
    }));
    const places = [...new Set(this.series.flatMap((x) => x.rows.map((r) => r.at)))].sort((a, b) => a - b);
    const banded = groups.some((g) => g.profiles.length > 1);
    if (!this.evaluated.firstChild) {
      this.heading = h("h2");
      this.profiles = h("div", { class: "profiles" });
      fill(
        this.evaluated,
        h(
          "section",
          { class: "card", "data-part": "evaluations" },
          h("div", { class: "card-head wrap" }, this.heading, this.pick),
          this.profiles,
        ),
      );
    }
    this.heading.textContent = `${chosen.table.title}, evaluated`;
    if (!places.length) {
      fill(this.profiles, h("p", { class: "pad muted" }, `No episode counts. ${chosen.table.description}`));
      return;
    }
    const { format, metric } = this.axis;
    const cell = (r) =>
      h(
        "td",
        { class: "num", title: r ? `${format(r.low)} to ${withUnit(metric, r.high)}` : null },
        r ? [format(r.mean), h("div", { class: "muted" }, `± ${format((r.high - r.low) / 2)}`)] : "–",
      );
    fill(
      this.numbers,
      table(
        [
          heading([axis.title, shownUnit(metric)].filter(Boolean).join("; ")),
          places.map((at) => heading(withUnit(axis, at), true)),
        ],
        this.series.map((x) =>
          h(
            "tr",
            null,
            h(
              "th",
              { scope: "row", class: "compare-name" },
              h(
                "div",
                { class: "row" },
                h("span", { class: "swatch", style: { background: `var(${x.token})` } }),
                h("span", null, x.label, x.count > 1 ? ` (${x.count})` : null),
              ),
            ),
            places.map((at) => cell(x.rows.find((r) => r.at === at))),
          ),
        ),
        { class: "plain" },
      ),
    );
    fill(
      this.profiles,
      h("div", { class: "pad" }, this.figure.element),
      h(
        "div",
        null,
        this.numbers,
        h(
          "p",
          { class: "pad muted" },
          banded
            ? "Band: one standard deviation between the jobs of a group; of a single job, the interval of its evaluation."
            : "Band: the interval of the evaluation.",
        ),
      ),
    );
    this.figure.redraw();
  }

  draw() {
    const groups = this.groups();
    for (const { curve, chart } of this.charts) chart.setData(() => this.columns(curve, groups));
  }

  /** What a chart shows of a curve: x, then a line for each job, or high, low and mean for each group. */
  columns(curve, groups) {
    const axis = X_AXES[this.x];
    const banded = this.by !== "none";
    const [metric] = curve.metrics;
    const curves = new Map(
      curve.items.map((item) => {
        const [x, y] = dense(axis.column(item.metrics), item.metrics.get(metric.name));
        return [item, [x, smooth(y, this.weight)]];
      }),
    );
    const all = [...curves.values()].filter(([x]) => x.length);
    const points = all.reduce((sum, [x]) => sum + x.length, 0);
    if (!points) return [[], ...groups.flatMap(() => (banded ? [[], [], []] : [[]]))];
    const low = Math.min(...all.map(([x]) => x[0]));
    const high = Math.max(...all.map(([x]) => x.at(-1)));
    const grid = (count) => Array.from({ length: count }, (_, i) => low + ((high - low) * i) / (count - 1));
    if (banded) {
      const xs = grid(GRID);
      return [
        xs,
        ...groups.flatMap((g) => {
          const b = band(
            g.items.filter((item) => curves.has(item)).map((item) => curves.get(item)),
            xs,
            metric.unit === "%" ? 1 : Infinity,
          );
          return [b.high, b.low, b.mean];
        }),
      ];
    }
    const tables = groups.map((g) => curves.get(g.items[0]) ?? [[], []]);
    if (points > MAX_JOINED) {
      const xs = grid(FINE_GRID);
      return [xs, ...tables.map(([x, y]) => xs.map((at) => interpolate(x, y, at)))];
    }
    const joined = uPlot.join(all);
    let at = 1;
    return [joined[0], ...tables.map(([x]) => (x.length ? joined[at++] : new Array(joined[0].length).fill(null)))];
  }

  onJob(job) {
    const item = this.items.find((i) => i.job.id === job.id);
    if (!item || newer(item.job, job) !== job) return;
    const ended = item.job.state !== job.state && isEnded(job.state);
    item.job = job;
    if (ended)
      this.evaluation(job.id).then(
        (e) => {
          item.evaluation = e;
          this.paintTable();
          this.paintEvaluations();
          this.plots.update(this.plotted());
        },
        () => {
          /* the next visit shows it */
        },
      );
    const row = latest(job);
    if (row.step !== undefined && row.step !== item.metrics.step.at(-1)) item.metrics.push(row);
    this.refresh ??= setTimeout(() => {
      this.refresh = null;
      const keys = (charts) => charts.map(({ key, items }) => `${key} ${items.length}`).join();
      if (keys(this.wanted()) !== keys(this.charts.map(({ curve }) => curve))) return this.rebuildCharts();
      this.paintTable();
      this.draw();
    }, 500);
  }

  suggest() {
    clearTimeout(this.typing);
    this.typing = setTimeout(async () => {
      const q = this.picker.value.trim();
      if (!q || q.startsWith("job_")) return;
      try {
        const page = await call(`jobs${query({ q, limit: 20 })}`, { signal: this.signal });
        fill(
          this.found,
          page.items
            .filter((j) => !this.ids.includes(j.id))
            .map((j) => h("option", { value: j.id }, `${j.name} · ${summary(j)} · ${j.state}`)),
        );
      } catch {
        /* suggestions are an extra */
      }
    }, 200);
  }

  add(id) {
    const wanted = id.trim();
    if (!wanted.startsWith("job_")) return;
    this.group = null;
    this.open([...new Set([...this.ids, wanted])]);
  }

  remove(id, how) {
    this.group = null;
    this.ids = this.ids.filter((x) => x !== id);
    this.open(this.ids, how);
  }

  open(ids, how) {
    const usual = this.group ? "settings" : "none";
    const address = {
      group: this.group,
      jobs: this.group ? null : ids.join(","),
      by: this.by === usual ? null : this.by,
      x: this.x === USUAL_AXIS ? null : this.x,
      smoothing: this.weight === USUAL_SMOOTHING ? null : this.weight,
    };
    this.go(`/compare${query(address)}`, how);
  }

  csv() {
    const names = [...new Set(this.items.flatMap(({ metrics }) => [...metrics.columns.keys()]))];
    const rows = [["job", "name", "seed", "step", ...names]];
    for (const { job, metrics } of this.items)
      metrics.step.forEach((step, i) =>
        rows.push([job.id, job.name, job.spec.seed, step, ...names.map((n) => metrics.get(n)[i])]),
      );
    save(new Blob([csv(rows)], { type: "text/csv" }), "comparison.csv");
  }
}

/** Show the page in `root`. */
export async function mount(root, context) {
  const view = new CompareView(root, context);
  await view.start();
  return { destroy: () => view.destroy(), update: (where) => view.update(where) };
}
