/** One row of the list of jobs. */

import { fill, h, icon, setText } from "../dom.js";
import { ago, compact, duration, integer, metricText, percent, shownUnit, significant, stamp } from "../format.js";
import { latest, progress, remaining, shownMetric, summary, valueIn } from "../jobs.js";
import { actionsFor, isEnded, stateBadge, stateNote, tone } from "../states.js";

/** One table row that is updated in place. */
export class Row {
  constructor(job, list) {
    this.list = list;
    this.check = h("input", { type: "checkbox", onchange: () => list.select(this.job.id, this.check.checked) });
    this.link = h("a", { href: `#/jobs/${job.id}` });
    this.sub = h("div", { class: "sub" });
    this.state = h("td", { class: "st" });
    this.percent = h("span");
    this.steps = h("span", { class: "muted" });
    this.fillBar = h("span");
    this.bar = h("div", { class: "bar", role: "progressbar", "aria-valuemin": 0, "aria-valuemax": 100 }, this.fillBar);
    const cell = (label, extra) => h("td", { class: ["num figs", extra], "data-label": label });
    this.metrics = [];
    this.cells = [];
    this.own = [];
    this.ownCells = [];
    this.rate = cell("Steps/s", "rate");
    this.eta = cell("Time left");
    this.age = h("td", { class: "num age muted" });
    this.owner = h("td", { class: "owner muted" });
    this.actions = h("div", { class: "row" });
    const done = h("td", { class: "progress" }, h("div", { class: "row" }, this.percent, this.steps), this.bar);
    this.named = {
      state: this.state,
      progress: done,
      rate: this.rate,
      eta: this.eta,
      owner: this.owner,
      age: this.age,
    };
    this.element = h(
      "tr",
      { "data-job": job.id },
      h("td", { class: "check" }, this.check),
      h("td", { class: "name" }, this.link, this.sub),
      this.state,
      done,
      this.rate,
      this.eta,
      this.owner,
      this.age,
      h("td", { class: "actions" }, this.actions),
    );
    this.update(job);
  }

  /** Show these metrics, and the values of these names, each in a cell. */
  setColumns(metrics, own) {
    for (const cell of [...this.cells, ...this.ownCells]) cell.remove();
    this.metrics = metrics;
    this.own = own;
    this.cells = metrics.map((m) => h("td", { class: "num figs", "data-label": m.title }));
    this.ownCells = own.map((name) => h("td", { class: "num figs", "data-label": name, "data-own": name }));
    this.rate.before(...this.cells, ...this.ownCells);
    this.paintMetrics();
  }

  /** Hide the columns with these keys. */
  hide(keys) {
    for (const [key, cell] of Object.entries(this.named)) cell.hidden = keys.has(key);
    this.cells.forEach((cell, i) => {
      cell.hidden = keys.has(`metric:${this.metrics[i].name}`);
    });
  }

  paintMetrics() {
    this.own.forEach((name, i) => {
      const value = valueIn(this.job, name);
      setText(this.ownCells[i], value === null ? "–" : Number.isFinite(value) ? significant(value, 4) : String(value));
    });
    const own = new Map(this.list.known.listed(this.job.spec).map((m) => [m.name, m]));
    this.metrics.forEach(({ name }, i) => {
      const metric = own.get(name);
      const shown = metric ? shownMetric(this.job, metric) : null;
      const text = shown ? metricText(metric, shown.value) : "–";
      figure(this.cells[i], text, metric ? shownUnit(metric) : "", Boolean(shown?.training) && text !== "–");
      this.cells[i].title =
        !shown || text === "–"
          ? ""
          : shown.training
            ? "During training, with exploration"
            : `Evaluation of ${integer(this.job.result.episodes)} episodes`;
    });
  }

  update(job) {
    const before = this.job;
    this.job = job;
    const m = latest(job);
    this.check.setAttribute("aria-label", `Select ${job.name}`);
    setText(this.link, job.name);
    if (!before || before.tags.join() !== job.tags.join())
      fill(
        this.sub,
        h("span", null, summary(job)),
        job.tags.map((t) => h("a", { class: "tag", href: `#/?tag=${encodeURIComponent(t)}` }, t)),
      );
    const key = job.state + (stateNote(job) ?? "");
    if (this.key !== key) {
      fill(this.state, stateBadge(job.state, stateNote(job)));
      fill(
        this.actions,
        actionsFor(job).map((a) =>
          h(
            "button",
            {
              class: ["ghost square", a.danger && "danger"],
              title: a.label,
              "aria-label": `${a.label} ${job.name}`,
              "data-action": a.name,
              onclick: (event) => this.list.act(this.job, a.name, event.currentTarget),
            },
            icon(a.icon),
          ),
        ),
      );
      this.key = key;
    }
    const share = progress(job);
    setText(this.percent, share > 0 && share < 0.001 ? "<0.1 %" : percent(share, share < 1 ? 1 : 0));
    setText(this.steps, `${compact(job.progress_step)} / ${compact(job.total_steps)}`);
    this.bar.dataset.tone = isEnded(job.state) || job.state === "paused" ? tone(job.state) : "blue";
    this.bar.setAttribute("aria-valuenow", Math.round(share * 100));
    this.bar.setAttribute("aria-label", `${job.name}: steps done`);
    this.fillBar.style.width = `${share * 100}%`;
    this.fillBar.hidden = share === 0;
    this.paintMetrics();
    figure(this.rate, job.state === "running" ? integer(m.steps_per_s) : "–");
    setText(this.owner, job.owner);
    this.tick();
  }

  /** What changes with time alone. */
  tick() {
    setText(this.eta, isEnded(this.job.state) ? "–" : duration(remaining(this.job)));
    setText(this.age, ago(this.job.created_at));
    this.age.title = `Submitted ${stamp(this.job.created_at)}${this.job.started_at ? `, trained ${duration(latest(this.job).time_s)}` : ""}`;
  }
}

function figure(cell, text, unit, training = false) {
  const key = `${text}${training}`;
  if (cell.dataset.key === key) return;
  cell.dataset.key = key;
  fill(
    cell,
    text,
    unit && text !== "–" ? h("span", { class: "unit" }, unit) : null,
    training ? h("span", { class: "unit" }, "training") : null,
  );
}
