/** One job: metrics, curves, log, checkpoints, timeline, evaluations and specification, all live. */

import { call, every, may, query } from "../api.js";
import { Columns } from "../columns.js";
import { descriptions } from "../descriptions.js";
import { fill, h, icon, setText, toast } from "../dom.js";
import {
  compact,
  duration,
  fixed,
  integer,
  intervalText,
  metricText,
  minute,
  percent,
  shortTime,
  shownUnit,
  stamp,
  withUnit,
} from "../format.js";
import { act, latest, newer, progress, remaining, shownMetric, summary, worked } from "../jobs.js";
import { actionsFor, isEnded, stateBadge, stateNote, tone } from "../states.js";
import { follow } from "../stream.js";
import { CheckpointsTab } from "./job-checkpoints.js";
import { CurvesTab } from "./job-curves.js";
import { editJob, shareJob } from "./job-edit.js";
import { EvaluationTab } from "./job-evaluation.js";
import { HistoryTab } from "./job-history.js";
import { LogTab } from "./job-log.js";
import { ReplayTab } from "./job-replay.js";
import { ReportTab } from "./job-report.js";
import { SpecTab } from "./job-spec.js";
import { loading, notice, waiting } from "./messages.js";

const MAX_POINTS = 4000;
const TAIL = 1000;
/** Most lines of the log that the page keeps while a job writes more. */
const MOST_LINES = 20_000;
const POLL_MS = 4000;
/** Number of metrics above the tabs. */
const MOST_STATS = 3;

/** Data of one job; views listen to the topics job, metrics, events, logs, checkpoints and evaluations. */
class JobStore extends EventTarget {
  constructor(id, signal) {
    super();
    this.id = id;
    this.signal = signal;
    this.path = `jobs/${encodeURIComponent(id)}`;
    this.metrics = new Columns();
    this.events = [];
    this.logs = [];
    this.logsBefore = false;
    this.checkpoints = null;
    this.evaluations = null;
    /** Number of the last request of each list, and the timer of the next. */
    this.turns = {};
    this.polls = {};
    signal.addEventListener("abort", () => Object.values(this.polls).forEach(clearTimeout));
  }

  notify(topic) {
    this.dispatchEvent(new Event(topic));
  }

  /** Call `listener` at every change of a topic while the page is shown. */
  on(topic, listener) {
    this.addEventListener(topic, listener, { signal: this.signal });
  }

  get(path, params = {}) {
    return call(`${path}${query(params)}`, { signal: this.signal });
  }

  async load() {
    const job = await this.get(this.path); // first, so that the other answers have all that an ended job recorded
    const [known, metrics, events, logs] = await Promise.all([
      descriptions(),
      this.get(`${this.path}/metrics`, { max_points: MAX_POINTS }),
      this.pages(`${this.path}/events`, 500),
      this.tail(),
    ]);
    this.known = known;
    this.metrics.load(metrics.columns);
    this.lastSeq = metrics.last_seq;
    this.events = events;
    this.logs = logs;
    this.setJob(job);
    for (const topic of ["metrics", "events", "logs"]) this.notify(topic);
  }

  /** Return all items of a paged list, oldest first. */
  async pages(path, limit) {
    const all = [];
    for (let after; ; ) {
      const page = await this.get(path, { after, limit });
      all.push(...page.items);
      if (page.items.length < limit || page.next_after === null) return all;
      after = page.next_after;
    }
  }

  /** The newest lines of the log. */
  async tail() {
    const page = await this.get(`${this.path}/logs`, { tail: true, limit: TAIL });
    this.logsBefore = page.items.length >= TAIL;
    return page.items;
  }

  /** Load the page of log lines before the first one. */
  async earlierLogs() {
    const before = this.logs[0]?.id;
    const page = await this.get(`${this.path}/logs`, { before, limit: TAIL });
    if (this.logs[0]?.id !== before) return; // asked for twice, or the first lines were dropped
    this.logs.unshift(...page.items);
    this.logsBefore = page.items.length >= TAIL;
  }

  /** Show a state from the stream. */
  setJob(job) {
    this.job = job;
    this.notify("job");
    if (!isEnded(job.state)) this.follow();
  }

  /** Show an answer, unless the stream has been faster. */
  answered(job) {
    this.setJob(newer(this.job, job));
  }

  /**
   * Read a list; no older answer replaces a newer one. What failed is read again, and so are open evaluations, whose
   * ends no stream reports.
   */
  async read(topic) {
    clearTimeout(this.polls[topic]);
    this.turns[topic] = (this.turns[topic] ?? 0) + 1;
    const turn = this.turns[topic];
    const current = () => turn === this.turns[topic] && !this.signal.aborted;
    let open = true;
    try {
      const items = await every(`${this.path}/${topic}`, { signal: this.signal });
      if (!current()) return;
      open = topic === "evaluations" && items.some((e) => !isEnded(e.state));
      this[topic] = items;
      this.notify(topic);
    } finally {
      if (open && current()) this.polls[topic] = setTimeout(() => this.read(topic).catch(() => {}), POLL_MS);
    }
  }

  /** Follow the job until it ends, starting after the data already loaded; does nothing if it is followed already. */
  follow() {
    if (this.following) return;
    this.following = true;
    const after = {
      metrics_after: this.lastSeq,
      logs_after: this.logs.at(-1)?.id,
      events_after: this.events.at(-1)?.id,
    };
    follow(`${this.path}/stream${query(after)}`, {
      signal: this.signal,
      lastId: this.lastId,
      onEvent: (type, data, id) => {
        this.lastId = id ?? this.lastId;
        this.receive(type, data);
      },
      onError: (error) => (error.status === 404 ? this.notify("gone") : toast(error.message, "error")),
    }).then(() => {
      this.following = false;
    });
  }

  /** Read the job again: one that has ended has no stream, though it can be edited, retried and deleted elsewhere. */
  async refresh() {
    try {
      const before = this.job.updated_at;
      this.answered(await this.get(this.path));
      if (this.job.updated_at !== before) this.follow(); // it may have run and ended meanwhile
      await this.read("evaluations");
    } catch (error) {
      if (error.status === 404) this.notify("gone");
    }
  }

  receive(type, data) {
    if (type === "metrics") {
      this.metrics.push(data);
      this.notify("metrics");
    } else if (type === "log") {
      if (this.logs.length && data.id <= this.logs.at(-1).id) return;
      this.logs.push(data);
      if (this.logs.length > MOST_LINES) {
        this.logs.splice(0, TAIL);
        this.logsBefore = true;
      }
      this.notify("logs");
    } else if (type === "event") {
      if (this.events.length && data.id <= this.events.at(-1).id) return;
      this.events.push(data);
      this.notify("events");
      if (data.kind === "checkpoint") this.read("checkpoints").catch(() => {});
      if (data.kind.startsWith("evaluat")) this.read("evaluations").catch(() => {});
    } else if (type === "state") this.setJob(data);
    else if (type === "end") this.read("evaluations").catch(() => {});
    else if (type === "gone") this.notify("gone");
  }
}

const TABS = [
  ["curves", "Curves", CurvesTab],
  ["evaluation", "Evaluation", EvaluationTab],
  ["replay", "Replay", ReplayTab],
  ["report", "Report", ReportTab],
  ["checkpoints", "Checkpoints", CheckpointsTab],
  ["log", "Log", LogTab],
  ["history", "History", HistoryTab],
  ["spec", "Specification", SpecTab],
];

class JobView {
  constructor(root, context) {
    this.root = root;
    this.go = context.go;
    this.id = context.id;
    this.signal = context.signal;
    this.store = new JobStore(context.id, context.signal);
    this.stats = {};
  }

  async start(where) {
    document.title = "Job · naosprint";
    fill(this.root, h("div", { class: "card" }, loading("Loading the job")));
    await this.store.load();
    await Promise.all([this.store.read("checkpoints"), this.store.read("evaluations")]);
    this.build();
    this.store.on("job", () => this.paint());
    this.store.on("metrics", () => this.paint());
    this.store.on("checkpoints", () => this.paintTabs());
    this.store.on("evaluations", () => this.paintTabs());
    this.timer = setInterval(() => this.paintStats(), 1000);
    this.paint();
    addEventListener("focus", () => this.store.following || this.store.refresh(), { signal: this.signal });
    this.store.on("gone", () => {
      toast(`${this.store.job.name} was deleted.`);
      this.go("/");
    });
    if (!this.update(where))
      fill(this.panel, notice("warn", `A job has no part “${where.tab}”.`, "Choose one of the parts above."));
  }

  destroy() {
    clearInterval(this.timer);
    this.tab?.destroy?.();
  }

  build() {
    const job = this.store.job;
    this.title = h("h1");
    this.badge = h("span");
    this.actions = h("div", { class: "row wrap" });
    this.sub = h("div", { class: "row wrap muted" });
    this.notes = h("p", { class: "notes", "data-part": "notes" });
    this.trouble = h("div");
    const stat = (key, label, cls) => {
      const cell = { k: null, v: h("div", { class: "v" }), d: h("div", { class: "d" }), bar: null };
      this.stats[key] = cell;
      cell.k = h("div", { class: "k" }, label);
      return h("div", { class: cls }, cell.k, cell.v, cell.d);
    };
    this.listed = this.store.known.listed(job.spec).slice(0, MOST_STATS);
    const done = stat("steps", "Steps", "wide");
    this.barFill = h("span");
    this.bar = h(
      "div",
      { class: "bar", role: "progressbar", "aria-valuemin": 0, "aria-valuemax": 100, "aria-label": "Steps done" },
      this.barFill,
    );
    done.append(this.bar);
    this.tabBar = h("nav", { class: "tabs", "aria-label": "Parts of this job" });
    this.panel = h("div");
    fill(
      this.root,
      h("div", { class: "crumbs" }, h("a", { href: "#/" }, "Jobs"), " / ", h("span", { class: "mono" }, job.id)),
      h("div", { class: "page-head" }, h("div", { class: "grow row wrap" }, this.title, this.badge), this.actions),
      this.sub,
      this.notes,
      this.trouble,
      h(
        "div",
        { class: "stats", style: { "margin-top": "1rem" } },
        done,
        this.listed.map((m) => stat(`metric:${m.name}`, m.title)),
        stat("rate", "Steps per second"),
        stat("elapsed", "Running for"),
      ),
      this.tabBar,
      this.panel,
    );
  }

  paint() {
    const job = this.store.job;
    document.title = `${job.name} · naosprint`;
    setText(this.title, job.name);
    const key = JSON.stringify([job.state, job.cancel_requested, job.waiting_reason, job.stalled_since]);
    if (key !== this.key) {
      this.key = key;
      fill(this.badge, stateBadge(job.state, stateNote(job)));
      const buttons = actionsFor(job).map((a) =>
        h(
          "button",
          {
            class: a.danger ? "danger" : null,
            "data-action": a.name,
            onclick: (event) => this.act(a.name, event.currentTarget),
          },
          icon(a.icon),
          a.label,
        ),
      );
      if (isEnded(job.state) && may("submit"))
        buttons.push(
          h(
            "button",
            { class: "danger", "data-action": "delete", onclick: (event) => this.act("delete", event.currentTarget) },
            icon("trash"),
            "Delete",
          ),
        );
      fill(
        this.actions,
        may("submit") &&
          h(
            "a",
            { class: "button", href: `#/submit?from=${job.id}` },
            icon("copy"),
            h("span", { class: "fold-tiny" }, "Submit again"),
          ),
        may("submit") && h("button", { "data-action": "edit", onclick: () => this.edit() }, "Edit"),
        may("submit") && h("button", { "data-action": "share", onclick: () => shareJob(this.store.job) }, "Share"),
        h("a", { class: "button", href: `#/compare?jobs=${job.id}` }, "Compare"),
        buttons,
      );
      fill(
        this.trouble,
        job.state === "queued" && job.waiting_reason
          ? h("div", { style: { "margin-top": "1rem" }, "data-part": "waiting" }, waiting(job))
          : job.stalled_since
            ? h(
                "div",
                { style: { "margin-top": "1rem" }, "data-part": "stalled" },
                notice(
                  "warn",
                  "The job has stalled.",
                  `Its last step was at ${stamp(job.stalled_since)}. Its worker will stop and retry it.`,
                ),
              )
            : job.error
              ? h(
                  "div",
                  { style: { "margin-top": "1rem" } },
                  notice(
                    job.state === "failed" ? "error" : "warn",
                    job.state === "failed" ? "The job failed." : "An attempt was lost.",
                    job.error,
                  ),
                )
              : null,
      );
    }
    const about = JSON.stringify([job.worker, job.owner, job.tags, job.notes, job.parent_job_id]);
    if (about !== this.about) {
      this.about = about;
      this.paintAbout(job);
    }
    this.paintStats();
    this.paintTabs();
  }

  paintAbout(job) {
    const worker = job.worker ? [" · on ", h("span", { class: "mono" }, job.worker)] : null;
    setText(this.notes, job.notes);
    this.notes.hidden = !job.notes;
    fill(
      this.sub,
      h("span", null, summary(job), ` · seed ${job.spec.seed} · by ${job.owner}`, worker),
      job.tags.map((t) => h("a", { class: "tag", href: `#/?tag=${encodeURIComponent(t)}` }, t)),
      job.parent_job_id
        ? h("a", { class: "row", href: `#/jobs/${job.parent_job_id}` }, icon("branch"), "from another job")
        : null,
    );
  }

  paintStats() {
    const job = this.store.job;
    const m = latest(job);
    const s = this.stats;
    if (!s.steps) return;
    const show = (cell, value, unit, note) => {
      const key = `${value}|${note}`;
      if (cell.key === key) return;
      cell.key = key;
      fill(cell.v, value, unit && value !== "–" ? h("span", { class: "unit" }, unit) : null);
      fill(cell.d, note ?? "\u00a0");
    };
    const share = progress(job);
    show(s.steps, compact(job.progress_step), `of ${compact(job.total_steps)}`, `${percent(share)} done`);
    this.bar.dataset.tone = isEnded(job.state) || job.state === "paused" ? tone(job.state) : "blue";
    this.bar.setAttribute("aria-valuenow", Math.round(share * 100));
    this.barFill.style.width = `${share * 100}%`;
    this.barFill.hidden = share === 0;
    for (const metric of this.listed) {
      const shown = shownMetric(job, metric);
      const best = metric.better && shown.training ? this.best(metric) : null;
      const note = shown.training
        ? `in training${best !== null ? `, best ${withUnit(metric, best)}` : ""}`
        : `${integer(job.result.episodes)} episodes${shown.interval ? `, ${intervalText(metric, shown.interval)}` : ""}`;
      show(s[`metric:${metric.name}`], metricText(metric, shown.value), shownUnit(metric), note);
    }
    show(
      s.rate,
      integer(m.steps_per_s),
      null,
      m.collect_s !== undefined && m.learn_s !== undefined
        ? `collect ${shortTime(m.collect_s)}, learn ${shortTime(m.learn_s)}${
            m.cpus !== undefined ? `; ${fixed(m.cpus, 1)} CPUs, ${integer(m.memory_mb)} MiB` : ""
          }`
        : null,
    );
    const left = remaining(job);
    setText(s.rate.k, isEnded(job.state) ? "Steps per second at last" : "Steps per second");
    setText(s.elapsed.k, isEnded(job.state) || job.state === "paused" ? "Ran for" : "Running for");
    show(
      s.elapsed,
      duration(worked(job, this.store.events)),
      null,
      job.state === "queued"
        ? "in the queue"
        : left !== null
          ? `${duration(left)} left`
          : job.finished_at
            ? `ended ${minute(job.finished_at)}`
            : job.attempt > 1
              ? `attempt ${job.attempt}`
              : null,
    );
  }

  /** The best value of a metric so far; null without one. */
  best({ name, better }) {
    if (this.bestLength !== this.store.metrics.length) {
      this.bestLength = this.store.metrics.length;
      this.bests = {};
    }
    if (!(name in this.bests)) {
      let best = null;
      for (const v of this.store.metrics.get(name))
        if (v !== null && (best === null || (better === "lower" ? v < best : v > best))) best = v;
      this.bests[name] = best;
    }
    return this.bests[name];
  }

  paintTabs() {
    const counts = { checkpoints: this.store.checkpoints?.length, evaluation: this.store.evaluations?.length };
    const key = JSON.stringify([counts, this.tabName]);
    if (key === this.tabKey) return;
    this.tabKey = key;
    fill(
      this.tabBar,
      TABS.map(([name, label]) =>
        h(
          "a",
          {
            href: `#/jobs/${this.id}${name === "curves" ? "" : `/${name}`}`,
            "aria-current": name === this.tabName ? "page" : null,
            "data-tab": name,
          },
          label,
          counts[name] ? h("span", { class: "count" }, counts[name]) : null,
        ),
      ),
    );
  }

  /** Show another part of the same job. */
  update({ id, tab, sub, params }) {
    if (id !== this.id || !this.panel) return false;
    const name = tab ?? "curves";
    const found = TABS.find(([key]) => key === name);
    if (!found) return false;
    if (name === this.tabName) return this.tab.update?.({ sub, params }) ?? true;
    this.tab?.destroy?.();
    this.tabName = name;
    this.paintTabs();
    const Tab = found[2];
    this.panel.replaceChildren();
    this.tab = new Tab(this.panel, this.store, { sub, params, go: this.go });
    return true;
  }

  async edit() {
    const changed = await editJob(this.store.job);
    if (changed) this.store.answered(changed);
  }

  async act(name, button) {
    const answer = await act(this.store.job, name, button);
    if (!answer) await this.store.refresh();
    else if (name === "delete") this.go("/");
    else this.store.answered(answer);
  }
}

/** Show the page in `root`. */
export async function mount(root, context) {
  const view = new JobView(root, context);
  await view.start(context);
  return { destroy: () => view.destroy(), update: (where) => view.update(where) };
}
