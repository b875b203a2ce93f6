/** All jobs, live: filter, search, sort, choose columns, act on one or on several, choose some to compare. */

import { call, may, query } from "../api.js";
import { common, Descriptions, descriptions, nameOf } from "../descriptions.js";
import { confirmDialog, fill, h, icon, isTyping, setText, toast } from "../dom.js";
import { integer, words } from "../format.js";
import { act, latest, namesOf, newer, progress, remaining, shownMetric, valueIn } from "../jobs.js";
import { read, write } from "../kept.js";
import { ACTIVE, actionsFor, isEnded } from "../states.js";
import { follow } from "../stream.js";
import { GROUPS, ListMenus } from "./job-lists.js";
import { JobPlots, PLOT_KEYS } from "./job-plots.js";
import { Row } from "./job-row.js";
import { loading, problem } from "./messages.js";

/** Jobs of the first answer, which is shown at once, and of the others. */
const FIRST = 50;
const PAGE = 200;
/** Most jobs that the page holds. */
const MOST = 5000;
/** Lists up to this length are drawn as a whole; of longer ones, only the rows near the view. */
const WHOLE = 60;
/** Rows drawn beyond each edge of the view. */
const MARGIN = 12;
/** Columns of metrics. */
const MOST_METRICS = 3;
const FILTERS = [
  ["", "All"],
  ["active", "Active"],
  ["paused", "Paused"],
  ["succeeded", "Succeeded"],
  ["failed", "Failed"],
  ["cancelled", "Cancelled"],
];
const STATES = { "": [], active: ACTIVE, paused: ["paused", "pausing"] };
const statesOf = (key) => STATES[key] ?? [key];
const HIDDEN_KEY = "naosprint.jobs.hidden";
const OWN_KEY = "naosprint.jobs.columns";

/** Columns by key, with what they sort by; metrics stand in front of the steps per second. */
const COLUMNS = [
  { key: "name", title: "Name", fixed: true, value: (job) => job.name.toLowerCase() },
  { key: "state", title: "State", value: (job) => [...ACTIVE, "succeeded", "failed", "cancelled"].indexOf(job.state) },
  { key: "progress", title: "Progress", value: progress },
  {
    key: "rate",
    title: "Steps/s",
    number: true,
    value: (job) => (job.state === "running" ? latest(job).steps_per_s : null),
  },
  { key: "eta", title: "Time left", number: true, value: (job) => (isEnded(job.state) ? null : remaining(job)) },
  { key: "owner", title: "Owner", value: (job) => job.owner },
  { key: "age", title: "Submitted", number: true, value: (job) => job.created_at },
];

const readNames = (key) => new Set(read(key) ?? []);
const writeNames = (key, names) => write(key, [...names]);

/** What the address of this page says: what is asked of the service, then how it is shown. */
const ASKED = ["state", "tag", "q", "task", "robot", "owner", "group"];
const SHOWN = ["sort", "by", ...PLOT_KEYS];
const filterOf = (params) => Object.fromEntries([...ASKED, ...SHOWN].map((name) => [name, params.get(name) ?? ""]));

class JobsView {
  constructor(root, { params, signal, go }) {
    this.root = root;
    this.signal = signal;
    this.go = go;
    this.jobs = new Map();
    this.rows = new Map();
    this.order = [];
    this.selected = new Set();
    /** Newest state of each job from the stream; an older answer does not replace it. */
    this.news = new Map();
    /** Jobs that were deleted; an older answer does not bring them back. */
    this.deleted = new Set();
    this.known = new Descriptions();
    this.metrics = [];
    this.hidden = readNames(HIDDEN_KEY);
    /** Settings, results and metrics that the user has added as columns. */
    this.own = readNames(OWN_KEY);
    this.filter = filterOf(params);
    this.turn = 0;
    this.fresh = new Set();
  }

  async start() {
    document.title = "Jobs · naosprint";
    this.segments = FILTERS.map(([key, label]) =>
      h(
        "button",
        { "aria-pressed": String(key === this.filter.state), onclick: () => this.apply({ state: key }) },
        label,
      ),
    );
    this.search = h("input", {
      type: "search",
      placeholder: "Search name, tag, task, robot or id",
      "aria-label": "Search jobs by name, tag, task, robot or id",
      value: this.filter.q,
      oninput: () => {
        clearTimeout(this.typing);
        this.typing = setTimeout(() => {
          this.typing = null;
          this.apply({ q: this.search.value.trim() });
        }, 250);
      },
    });
    this.count = h("span", { class: "muted", role: "status" });
    this.tag = h("div", { class: "row" });
    this.menus = new ListMenus(this);
    this.columnList = h("div", { class: "menu-list" });
    this.columnMenu = h("details", { class: "menu" }, h("summary", { class: "button" }, "Columns"), this.columnList);
    this.above = h("tbody", { "aria-hidden": "true" });
    this.body = h("tbody");
    this.below = h("tbody", { "aria-hidden": "true" });
    this.box = h("div", { class: "card" }, loading("Loading jobs"));
    this.bar = h("div", { class: "select-bar", hidden: true });
    this.plotButton = h("button", { onclick: () => this.apply({ plot: this.filter.plot ? "" : "scatter" }) }, "Plot");
    this.plotBox = h("div");
    fill(
      this.root,
      h("div", { class: "page-head" }, h("h1", null, "Jobs"), this.count),
      h(
        "div",
        { class: "filters" },
        h("div", { class: "segments", role: "group", "aria-label": "Show by state" }, this.segments),
        h("div", { class: "search" }, icon("search"), this.search),
        this.tag,
        this.menus.elements,
        h("div", { class: "row menus" }, this.plotButton, this.columnMenu, this.menus.viewsMenu),
      ),
      this.plotBox,
      this.box,
      this.bar,
    );
    this.paintTag();
    this.keys = (event) => this.onKey(event);
    addEventListener("keydown", this.keys);
    this.scrolled = () => this.soon();
    addEventListener("scroll", this.scrolled, { passive: true });
    addEventListener("resize", this.scrolled);
    this.timer = setInterval(() => {
      for (const row of this.rows.values()) row.tick();
    }, 5000);
    // The list is read once the stream is connected, so that no change in between is missed.
    follow("jobs/stream", {
      signal: this.signal,
      onEvent: (type, job) => this.onEvent(type, job),
      onError: () => this.load(),
    });
    this.fallback = setTimeout(() => this.loaded || this.load(), 1500);
  }

  destroy() {
    removeEventListener("keydown", this.keys);
    removeEventListener("scroll", this.scrolled);
    removeEventListener("resize", this.scrolled);
    cancelAnimationFrame(this.frame);
    cancelAnimationFrame(this.painting);
    clearInterval(this.timer);
    clearTimeout(this.typing);
    clearTimeout(this.fallback);
    this.plots?.destroy();
  }

  /** Apply a change of the address within this page. */
  update({ path, params }) {
    if (path !== "/" && path !== "") return false;
    const before = this.filter;
    this.filter = filterOf(params);
    const next = this.filter;
    this.menus.paint();
    if (ASKED.every((name) => next[name] === before[name])) {
      if (SHOWN.some((name) => next[name] !== before[name])) this.paint();
      return true;
    }
    if (!this.typing && this.search.value.trim() !== next.q) this.search.value = next.q;
    FILTERS.forEach(([key], i) => this.segments[i].setAttribute("aria-pressed", String(key === next.state)));
    this.paintTag();
    this.load();
    return true;
  }

  apply(change) {
    this.go(`/${query({ ...this.filter, ...change })}`, {
      replace: ["q", "sort", ...PLOT_KEYS].some((name) => name in change),
    });
  }

  paintTag() {
    const { tag } = this.filter;
    fill(
      this.tag,
      tag
        ? [
            h("span", { class: "muted" }, "Tag"),
            h(
              "button",
              { class: "small", "aria-label": `Stop filtering by tag ${tag}`, onclick: () => this.apply({ tag: "" }) },
              tag,
              icon("close"),
            ),
          ]
        : null,
    );
  }

  /** Read the jobs of the filter: the newest at once, then all others. */
  async load() {
    this.turn += 1;
    this.older = false;
    const turn = this.turn;
    const { state, ...others } = Object.fromEntries(ASKED.map((name) => [name, this.filter[name]]));
    let cursor = null;
    try {
      do {
        const limit = cursor ? Math.min(PAGE, MOST - this.jobs.size) : FIRST;
        const params = query({ state: statesOf(state), ...others, limit, cursor });
        const [known, page] = await Promise.all([descriptions(), call(`jobs${params}`, { signal: this.signal })]);
        if (turn !== this.turn) return;
        this.known = known;
        if (!cursor) {
          this.jobs.clear();
          this.rows.clear();
          this.loaded = true;
        }
        for (const job of page.items) this.put(job);
        // what the stream has sent since the answer was made
        for (const job of this.news.values()) if (this.fits(job)) this.put(job);
        cursor = page.next_cursor;
        this.paint();
      } while (cursor && this.jobs.size < MOST);
      this.older = Boolean(cursor);
      this.paintCount();
    } catch (error) {
      if (error.name === "AbortError" || turn !== this.turn) return;
      fill(
        this.box,
        problem(error, () => {
          fill(this.box, loading());
          this.load();
        }),
      );
    }
  }

  put(given) {
    const job = newer(this.news.get(given.id), given);
    if (this.deleted.has(job.id) || (job !== given && !this.fits(job))) return;
    this.jobs.set(job.id, job);
    this.rows.get(job.id)?.update(job);
  }

  /** All columns, those of metrics included. */
  columns() {
    const metrics = this.metrics.map((metric) => ({
      key: `metric:${metric.name}`,
      title: metric.title,
      number: true,
      value: (job) => shownMetric(job, metric).value,
    }));
    const own = [...this.own].map((name) => ({
      key: `own:${name}`,
      title: name,
      number: true,
      value: (job) => valueIn(job, name),
    }));
    return COLUMNS.flatMap((column) => (column.key === "rate" ? [...metrics, ...own, column] : [column]));
  }

  /** Show the listed jobs as a plot above the list, if the address says so. */
  paintPlots() {
    const { plot } = this.filter;
    this.plotButton.setAttribute("aria-pressed", String(Boolean(plot)));
    if (!plot || !this.jobs.size) {
      this.plots?.destroy();
      this.plots = null;
      return;
    }
    if (!this.plots) {
      this.plots = new JobPlots(this.known, this.filter, (change) => this.apply(change));
      fill(this.plotBox, this.plots.element);
    }
    this.plots.update([...this.jobs.values()], this.filter);
  }

  paintCount() {
    const count = this.jobs.size ? integer(this.jobs.size) : "";
    setText(this.count, this.older ? `The newest ${count}. Filters list older ones.` : count);
  }

  paint() {
    this.paintCount();
    this.paintPlots();
    if (!this.jobs.size) {
      this.paintEmpty();
      return;
    }
    // Jobs of one task list the same metrics.
    const tasks = new Map([...this.jobs.values()].map((job) => [nameOf(job.spec, "task"), job.spec]));
    const metrics = common([...tasks.values()].map((spec) => this.known.listed(spec))).slice(0, MOST_METRICS);
    if (metrics.map((m) => m.name).join() !== this.metrics.map((m) => m.name).join()) {
      this.metrics = metrics;
      this.rows.clear();
      this.head = null;
    }
    if (!this.head || !this.body.isConnected) {
      this.head = h("thead");
      this.table = h("table", { class: "jobs-table" }, this.head, this.body);
      fill(this.box, this.table);
      this.paintColumns();
    }
    this.sort();
    this.menus.paint();
    this.paintHead();
    this.drawn = null;
    this.draw();
    this.paintBar();
  }

  /** Paint once for all changes that arrive before the next frame. */
  paintSoon() {
    this.painting ??= requestAnimationFrame(() => {
      this.painting = null;
      this.paint();
      for (const id of this.fresh) this.rows.get(id)?.element.classList.add("fresh");
      this.fresh.clear();
    });
  }

  paintEmpty() {
    const filtered = ASKED.some((name) => this.filter[name]);
    fill(
      this.box,
      filtered
        ? h(
            "div",
            { class: "empty" },
            h("h2", null, "No matching jobs"),
            h("p", null, "No job matches this filter."),
            h("div", { class: "row" }, h("a", { class: "button", href: "#/" }, "Show all jobs")),
          )
        : h(
            "div",
            { class: "empty" },
            h("h2", null, "No jobs yet"),
            may("submit")
              ? [
                  h(
                    "p",
                    null,
                    "Submit one and watch a robot learn to run. ",
                    "With the preset “fast”, it runs after a few minutes on two cores.",
                  ),
                  h(
                    "div",
                    { class: "row" },
                    h("a", { class: "button primary", href: "#/submit" }, icon("plus"), "New job"),
                  ),
                  h("p", null, "or from a terminal: ", h("code", null, "naoctl submit --preset fast")),
                ]
              : null,
          ),
    );
    this.head = null;
    this.paintBar();
  }

  /** The head of the table, whose buttons sort; rebuilt, it keeps the focus. */
  paintHead() {
    const sorted = this.filter.sort.replace(/^-/, "");
    const down = this.filter.sort.startsWith("-");
    const all = h("input", {
      type: "checkbox",
      "aria-label": "Select all jobs of this list",
      checked: this.selected.size > 0 && this.order.every((id) => this.selected.has(id)),
      onchange: () => this.selectAll(all.checked),
    });
    const cell = ({ key, title, number }) => {
      const mine = sorted === key;
      const next = mine ? (down ? "" : `-${key}`) : key;
      return h(
        "th",
        {
          scope: "col",
          class: number ? "num" : null,
          hidden: this.hidden.has(key),
          "aria-sort": mine ? (down ? "descending" : "ascending") : null,
        },
        h(
          "button",
          { class: "sort", "data-sort": key, onclick: () => this.apply({ sort: next }) },
          title,
          h("span", { "aria-hidden": "true" }, mine ? (down ? " ↓" : " ↑") : ""),
        ),
      );
    };
    fill(
      this.head,
      h(
        "tr",
        null,
        h("th", { scope: "col" }, all),
        this.columns().map(cell),
        h("th", { scope: "col" }, h("span", { class: "sr" }, "Actions")),
      ),
    );
  }

  /** Show the columns that the user has chosen now. */
  setOwn() {
    writeNames(OWN_KEY, this.own);
    for (const row of this.rows.values()) row.setColumns(this.metrics, [...this.own]);
    this.sort();
    this.paintHead();
    this.paintColumns();
  }

  /** Show the columns of a saved view. */
  setView(own, hidden) {
    this.own = new Set(own);
    this.hidden = new Set(hidden);
    writeNames(HIDDEN_KEY, this.hidden);
    for (const row of this.rows.values()) row.hide(this.hidden);
    this.setOwn();
  }

  /** The field that adds a column. */
  adder() {
    const name = h("input", {
      id: "column-name",
      type: "text",
      list: "column-names",
      spellcheck: "false",
      required: true,
    });
    const names = () => namesOf([...this.jobs.values()]);
    const add = (event) => {
      event.preventDefault();
      const wanted = name.value.trim();
      name.setCustomValidity(names().includes(wanted) ? "" : "None of these jobs has it. Choose one of the list.");
      if (!name.reportValidity()) return;
      this.own.add(wanted);
      this.setOwn();
    };
    name.addEventListener("input", () => name.setCustomValidity(""));
    return h(
      "form",
      { class: "stack", onsubmit: add },
      h("div", { class: "field" }, h("label", { for: "column-name" }, "Add a setting or result"), name),
      h(
        "datalist",
        { id: "column-names" },
        names().map((value) => h("option", { value })),
      ),
      h("button", { type: "submit" }, "Add column"),
    );
  }

  /** The menu in which columns are chosen. */
  paintColumns() {
    const removable = [...this.own].map((name) =>
      h(
        "label",
        { class: "row" },
        h("input", {
          type: "checkbox",
          name: `own:${name}`,
          checked: true,
          onchange: () => {
            this.own.delete(name);
            this.setOwn();
          },
        }),
        name,
      ),
    );
    fill(
      this.columnList,
      this.columns()
        .filter((column) => !column.fixed && !column.key.startsWith("own:"))
        .map(({ key, title }) => {
          const box = h("input", {
            type: "checkbox",
            name: key,
            checked: !this.hidden.has(key),
            onchange: () => {
              if (box.checked) this.hidden.delete(key);
              else this.hidden.add(key);
              writeNames(HIDDEN_KEY, this.hidden);
              this.paintHead();
              for (const row of this.rows.values()) row.hide(this.hidden);
            },
          });
          return h("label", { class: "row" }, box, title);
        }),
      removable,
      this.adder(),
    );
  }

  /** Set the order of the rows: by the chosen column, else newest first; jobs without a value come last. */
  sort() {
    const key = this.filter.sort.replace(/^-/, "");
    const sign = this.filter.sort.startsWith("-") ? -1 : 1;
    const column = this.columns().find((c) => c.key === key);
    const newest = (a, b) => (a.id < b.id ? 1 : -1);
    const jobs = [...this.jobs.values()];
    if (!column) jobs.sort(newest);
    else {
      const values = new Map(jobs.map((job) => [job.id, column.value(job) ?? null]));
      jobs.sort((a, b) => {
        const [x, y] = [values.get(a.id), values.get(b.id)];
        if (x === y) return newest(a, b);
        if (x === null || y === null) return x === null ? 1 : -1;
        return x < y ? -sign : sign;
      });
    }
    this.order = jobs.map((job) => job.id);
    this.group(jobs);
  }

  /** Set the lines of the table: the jobs, in groups under headings if they are grouped. */
  group(jobs) {
    const by = GROUPS[this.filter.by];
    this.headings = new Map();
    if (!by) {
      this.lines = this.order;
      return;
    }
    const groups = Map.groupBy(jobs, by.value);
    const names = [...groups.keys()].sort();
    this.order = names.flatMap((name) => groups.get(name).map((job) => job.id));
    this.lines = names.flatMap((name) => {
      const key = `heading:${name}`;
      this.headings.set(key, by.heading(name, groups.get(name), this));
      return [key, ...groups.get(name).map((job) => job.id)];
    });
  }

  soon() {
    this.frame ??= requestAnimationFrame(() => {
      this.frame = null;
      this.draw();
    });
  }

  /** Draw the rows near the view; two spacers take the place of the others. */
  draw() {
    if (!this.table?.isConnected) return;
    const count = this.lines.length;
    let [first, last] = [0, count];
    if (count <= WHOLE) {
      this.above.remove();
      this.below.remove();
    } else {
      if (!this.above.isConnected) {
        this.body.before(this.above);
        this.body.after(this.below);
      }
      const pitch = this.pitch ?? 64;
      const top = -this.above.getBoundingClientRect().top;
      first = Math.max(0, Math.min(count - 1, Math.floor(top / pitch) - MARGIN));
      last = Math.min(count, Math.ceil((top + innerHeight) / pitch) + MARGIN);
      last = Math.max(last, first + 1);
    }
    const key = `${first} ${last}`;
    if (key === this.drawn) return;
    this.drawn = key;
    const began = performance.now();
    const wanted = this.lines.slice(first, last).map((id) => this.headings.get(id) ?? this.row(id));
    const kept = new Set(wanted.map((row) => row.element));
    for (const element of [...this.body.children]) if (!kept.has(element)) element.remove();
    wanted.forEach((row, i) => {
      if (this.body.children[i] !== row.element) this.body.insertBefore(row.element, this.body.children[i] ?? null);
    });
    if (this.rows.size > 400) {
      const near = new Set(this.lines.slice(first, last));
      for (const id of this.rows.keys()) if (!near.has(id)) this.rows.delete(id);
    }
    if (count > WHOLE) this.pitch ??= this.body.getBoundingClientRect().height / wanted.length;
    const spacer = (part, rows) =>
      fill(part, rows ? h("tr", { class: "spacer", style: { height: `${rows * (this.pitch ?? 64)}px` } }) : null);
    spacer(this.above, first);
    spacer(this.below, count - last);
    if (count > WHOLE) performance.measure("jobs.draw", { start: began });
  }

  /** The row of a job, made when it is first seen. */
  row(id) {
    let row = this.rows.get(id);
    if (!row) {
      row = new Row(this.jobs.get(id), this);
      row.setColumns(this.metrics, [...this.own]);
      row.hide(this.hidden);
      this.rows.set(id, row);
    }
    row.check.checked = this.selected.has(id);
    return row;
  }

  onEvent(type, data) {
    if (type === "reset") this.news.clear();
    if (type === "reset" || (type === "ready" && !this.ready)) this.load();
    if (type === "ready") this.ready = true;
    if (type === "gone") {
      this.deleted.add(data.id);
      this.drop(data.id);
    }
    if (type !== "job") return;
    this.news.set(data.id, data);
    if (!this.loaded) return;
    const known = this.jobs.has(data.id);
    if (!this.fits(data)) {
      if (known) this.drop(data.id);
      return;
    }
    this.put(data);
    if (this.selected.has(data.id)) this.bar.querySelectorAll("[data-bulk]").forEach((b) => this.counted(b));
    if (known && !this.filter.sort) return;
    if (!known) this.fresh.add(data.id);
    this.paintSoon();
  }

  fits(job) {
    const { state, tag, q, task, robot, owner, group } = this.filter;
    const kind = [nameOf(job.spec, "task"), nameOf(job.spec, "robot")];
    const words = [job.name, job.id, ...kind, ...job.tags].join(" ").toLowerCase();
    return (
      (!state || statesOf(state).includes(job.state)) &&
      (!tag || job.tags.includes(tag)) &&
      (!task || task === kind[0]) &&
      (!robot || robot === kind[1]) &&
      (!owner || owner === job.owner) &&
      (!group || group === job.group_id) &&
      (!q || words.includes(q.toLowerCase()))
    );
  }

  drop(id) {
    if (!this.jobs.delete(id)) return;
    this.rows.delete(id);
    this.selected.delete(id);
    this.paintSoon();
  }

  async act(job, name, button) {
    const answer = await act(job, name, button);
    if (answer) this.answered(answer);
  }

  /** Show the answer to an action, unless the stream has been faster. */
  answered(job) {
    this.onEvent("job", newer(this.news.get(job.id), job));
  }

  select(id, on) {
    if (on) this.selected.add(id);
    else this.selected.delete(id);
    this.paintBar();
  }

  selectAll(on) {
    this.selected = new Set(on ? this.order : []);
    for (const [id, row] of this.rows) row.check.checked = this.selected.has(id);
    this.paintBar();
  }

  /** The selected jobs that allow an action. */
  allowing(name) {
    const jobs = [...this.selected].map((id) => this.jobs.get(id)).filter(Boolean);
    return jobs.filter((job) =>
      name === "delete" ? isEnded(job.state) : actionsFor(job).some((action) => action.name === name),
    );
  }

  paintBar() {
    const n = this.selected.size;
    this.bar.hidden = n === 0;
    if (!n) {
      fill(this.bar);
      return;
    }
    const bulk = (name) =>
      this.counted(h("button", { class: "small danger", "data-bulk": name, onclick: () => this.bulk(name) }));
    fill(
      this.bar,
      h("span", null, `${n} selected`),
      h("a", { class: "button primary small", href: `#/compare?jobs=${[...this.selected].join(",")}` }, "Compare"),
      bulk("cancel"),
      bulk("delete"),
      h("button", { class: "ghost small", onclick: () => this.selectAll(false) }, "Clear"),
    );
  }

  /** The button of an action with the number of selected jobs that allow it now. */
  counted(button) {
    const { bulk } = button.dataset;
    const count = this.allowing(bulk).length;
    setText(button, `${words(bulk)} ${count}`);
    button.disabled = !count;
    return button;
  }

  /** Cancel or delete the selected jobs that allow it, after one question. */
  async bulk(name) {
    const jobs = this.allowing(name);
    const many = jobs.length === 1 ? "1 job" : `${jobs.length} jobs`;
    const questions = {
      cancel: `Their trainings stop. Checkpoints and metrics so far are kept.`,
      delete: `Their metrics, logs, checkpoints and evaluations are deleted. This cannot be undone.`,
    };
    const verb = name === "cancel" ? "Cancel" : "Delete";
    const sure = await confirmDialog({
      title: `${verb} ${many}?`,
      body: questions[name],
      action: `${verb} ${many}`,
      danger: true,
    });
    if (!sure) return;
    const failed = [];
    for (const job of jobs) {
      const path = `jobs/${encodeURIComponent(job.id)}`;
      try {
        if (name === "delete") {
          await call(path, { method: "DELETE" });
          this.onEvent("gone", job);
        } else this.answered(await call(`${path}/${name}`, { method: "POST" }));
        this.selected.delete(job.id);
      } catch (error) {
        failed.push(`${job.name}: ${error.message}`);
      }
    }
    const done = jobs.length - failed.length;
    if (done)
      toast(`${done === 1 ? "1 job was" : `${done} jobs were`} ${name === "cancel" ? "cancelled" : "deleted"}.`);
    for (const message of failed.slice(0, 3)) toast(message, "error");
    this.paint();
  }

  /** Move the focus to the job at a position of the list, drawing it first. */
  focus(position) {
    const id = this.order[position];
    if (!this.row(id).element.isConnected) {
      const line = this.lines.indexOf(id);
      scrollTo(0, scrollY + this.above.getBoundingClientRect().top + line * (this.pitch ?? 64) - innerHeight / 2);
      this.draw();
    }
    this.row(id).link.focus();
  }

  onKey(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    if (event.key === "Escape" && document.activeElement === this.search) {
      this.search.blur();
      return;
    }
    if (isTyping(event)) return;
    const id = document.activeElement?.closest?.("tr[data-job]")?.dataset.job;
    const at = this.order.indexOf(id);
    if (event.key === "/") {
      event.preventDefault();
      this.search.focus();
    } else if ((event.key === "j" || event.key === "k") && this.order.length) {
      event.preventDefault();
      const next = at < 0 ? 0 : at + (event.key === "j" ? 1 : -1);
      this.focus(Math.max(0, Math.min(this.order.length - 1, next)));
    } else if (event.key === "x" && at >= 0) {
      this.select(id, !this.selected.has(id));
      this.row(id);
    }
  }
}

/** Show the page in `root`. */
export async function mount(root, context) {
  const view = new JobsView(root, context);
  await view.start();
  return { destroy: () => view.destroy(), update: (where) => view.update(where) };
}
