/** All jobs, live: filter, search, act, choose some to compare. */

import { call, query } from "../api.js";
import { common, Descriptions, descriptions } from "../descriptions.js";
import { fill, h, icon, isTyping, setText } from "../dom.js";
import { ago, compact, duration, integer, metricText, percent, shownUnit, stamp } from "../format.js";
import { act, elapsed, latest, progress, remaining, shownMetric, summary } from "../jobs.js";
import { ACTIVE, actionsFor, isEnded, stateBadge, stateNote, tone } from "../states.js";
import { follow } from "../stream.js";
import { loading, problem } from "./messages.js";

const PAGE = 50;
/** Columns of metrics. */
const MOST_METRICS = 3;
const FILTERS = [
  ["", "All"],
  ["active", "Active"],
  ["succeeded", "Succeeded"],
  ["failed", "Failed"],
  ["cancelled", "Cancelled"],
];
const statesOf = (key) => (key === "active" ? ACTIVE : key ? [key] : []);

/** One table row that is updated in place. */
class Row {
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
    this.rate = cell("Steps/s", "rate");
    this.eta = cell("Time left");
    this.age = h("td", { class: "num age muted" });
    this.owner = h("td", { class: "owner muted" });
    this.actions = h("div", { class: "row" });
    this.element = h(
      "tr",
      { "data-job": job.id },
      h("td", { class: "check" }, this.check),
      h("td", { class: "name" }, this.link, this.sub),
      this.state,
      h("td", { class: "progress" }, h("div", { class: "row" }, this.percent, this.steps), this.bar),
      this.rate,
      this.eta,
      this.owner,
      this.age,
      h("td", { class: "actions" }, this.actions),
    );
    this.update(job);
  }

  /** Show these metrics, each in a cell. */
  setMetrics(metrics) {
    for (const cell of this.cells) cell.remove();
    this.metrics = metrics;
    this.cells = metrics.map((m) => h("td", { class: "num figs", "data-label": m.title }));
    this.rate.before(...this.cells);
    this.paintMetrics();
  }

  paintMetrics() {
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
              onclick: () => this.list.act(this.job, a.name),
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
    this.age.title = `Submitted ${stamp(this.job.created_at)}${this.job.started_at ? `, ran ${duration(elapsed(this.job))}` : ""}`;
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

class JobsView {
  constructor(root, { params, signal, go }) {
    this.root = root;
    this.signal = signal;
    this.go = go;
    this.rows = new Map();
    this.selected = new Set();
    /** The newest state of each job that the stream has told of; an answer that is older does not undo it. */
    this.news = new Map();
    this.known = new Descriptions();
    this.metrics = [];
    this.cursor = null;
    this.filter = { state: params.get("state") ?? "", tag: params.get("tag") ?? "", q: params.get("q") ?? "" };
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
      placeholder: "Search name or id",
      "aria-label": "Search jobs by name or id",
      value: this.filter.q,
      oninput: () => {
        clearTimeout(this.typing);
        this.typing = setTimeout(() => this.apply({ q: this.search.value.trim() }), 250);
      },
    });
    this.tag = h("div", { class: "row" });
    this.body = h("tbody");
    this.more = h("button", { onclick: () => this.load(true) }, "Show more");
    this.moreBox = h(
      "div",
      { class: "row", style: { "justify-content": "center", "margin-top": "1rem" }, hidden: true },
      this.more,
    );
    this.box = h("div", { class: "card" }, loading("Loading jobs"));
    this.bar = h("div", { class: "select-bar", hidden: true });
    fill(
      this.root,
      h("div", { class: "page-head" }, h("h1", { class: "grow" }, "Jobs")),
      h(
        "div",
        { class: "filters" },
        h("div", { class: "segments", role: "group", "aria-label": "Show by state" }, this.segments),
        h("div", { class: "search" }, icon("search"), this.search),
        this.tag,
      ),
      this.box,
      this.moreBox,
      this.bar,
    );
    this.paintTag();
    this.keys = (event) => this.onKey(event);
    addEventListener("keydown", this.keys);
    this.timer = setInterval(() => {
      for (const row of this.rows.values()) row.tick();
    }, 5000);
    // The list is read once the stream says that nothing is missed from there on.
    follow("jobs/stream", {
      signal: this.signal,
      onEvent: (type, job) => this.onEvent(type, job),
      onError: () => this.load(false),
    });
    this.fallback = setTimeout(() => this.loaded || this.load(false), 1500);
  }

  destroy() {
    removeEventListener("keydown", this.keys);
    clearInterval(this.timer);
    clearTimeout(this.typing);
    clearTimeout(this.fallback);
  }

  /** Take over a change of the address within this page. */
  update({ path, params }) {
    if (path !== "/" && path !== "") return false;
    const next = { state: params.get("state") ?? "", tag: params.get("tag") ?? "", q: params.get("q") ?? "" };
    if (JSON.stringify(next) === JSON.stringify(this.filter)) return true;
    this.filter = next;
    if (document.activeElement !== this.search) this.search.value = next.q;
    FILTERS.forEach(([key], i) => this.segments[i].setAttribute("aria-pressed", String(key === next.state)));
    this.paintTag();
    this.load(false);
    return true;
  }

  apply(change) {
    this.go(`/${query({ ...this.filter, ...change })}`, { replace: "q" in change });
  }

  paintTag() {
    fill(
      this.tag,
      this.filter.tag
        ? [
            h("span", { class: "muted" }, "Tag"),
            h(
              "button",
              {
                class: "small",
                "aria-label": `Stop filtering by tag ${this.filter.tag}`,
                onclick: () => this.apply({ tag: "" }),
              },
              this.filter.tag,
              icon("close"),
            ),
          ]
        : null,
    );
  }

  async load(more) {
    this.turn = (this.turn ?? 0) + 1;
    const turn = this.turn;
    const { state, tag, q } = this.filter;
    try {
      const [known, page] = await Promise.all([
        descriptions(),
        call(`jobs${query({ state: statesOf(state), tag, q, limit: PAGE, cursor: more ? this.cursor : null })}`, {
          signal: this.signal,
        }),
      ]);
      this.known = known;
      if (turn !== this.turn) return;
      this.loaded = true;
      if (!more) {
        this.rows.clear();
        this.body.replaceChildren();
      }
      for (const job of page.items) this.put(job, "append");
      this.cursor = page.next_cursor;
      this.moreBox.hidden = !this.cursor;
      this.paint();
    } catch (error) {
      if (error.name === "AbortError" || turn !== this.turn) return;
      fill(
        this.box,
        problem(error, () => {
          fill(this.box, loading());
          this.load(false);
        }),
      );
    }
  }

  paint() {
    if (!this.rows.size) {
      const filtered = this.filter.state || this.filter.tag || this.filter.q;
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
              h(
                "p",
                null,
                "Submit one and watch a robot learn to run. With the preset “fast” it runs after some minutes on two cores.",
              ),
              h(
                "div",
                { class: "row" },
                h("a", { class: "button primary", href: "#/submit" }, icon("plus"), "New job"),
              ),
              h("p", null, "or from a terminal: ", h("code", null, "naoctl submit --preset fast")),
            ),
      );
      this.head = null;
      this.paintBar();
      return;
    }
    const metrics = common([...this.rows.values()].map((row) => this.known.listed(row.job.spec))).slice(
      0,
      MOST_METRICS,
    );
    const names = metrics.map((m) => m.name).join();
    if (names !== this.metrics.map((m) => m.name).join()) {
      this.metrics = metrics;
      this.head = null;
      for (const row of this.rows.values()) row.setMetrics(metrics);
    }
    if (!this.head || !this.body.isConnected) {
      const head = (text, cls) => h("th", { scope: "col", class: cls }, text);
      this.head = h(
        "thead",
        null,
        h(
          "tr",
          null,
          h("th", { scope: "col" }, h("span", { class: "sr" }, "Select")),
          head("Name"),
          head("State"),
          head("Progress"),
          metrics.map((m) => head(m.title, "num")),
          head("Steps/s", "num"),
          head("Time left", "num"),
          head("Owner"),
          head("Submitted", "num"),
          h("th", { scope: "col" }, h("span", { class: "sr" }, "Actions")),
        ),
      );
      fill(this.box, h("table", { class: "jobs-table" }, this.head, this.body));
    }
    this.paintBar();
  }

  put(given, where) {
    const streamed = this.news.get(given.id);
    const job = streamed && streamed.updated_at > given.updated_at ? streamed : given;
    const row = this.rows.get(job.id);
    if (row) {
      row.update(job);
      return;
    }
    const fresh = new Row(job, this);
    fresh.setMetrics(this.metrics);
    fresh.check.checked = this.selected.has(job.id);
    this.rows.set(job.id, fresh);
    if (where === "append") this.body.append(fresh.element);
    else {
      fresh.element.classList.add("fresh");
      this.body.prepend(fresh.element);
    }
  }

  onEvent(type, data) {
    if (type === "ready" && !this.loaded) this.load(false);
    if (type === "gone") this.drop(data.id);
    if (type !== "job") return;
    this.news.set(data.id, data);
    if (!this.loaded) return;
    const known = this.rows.has(data.id);
    if (!this.fits(data)) {
      if (known) this.drop(data.id);
      return;
    }
    if (
      !known &&
      this.rows.size &&
      new Date(data.created_at) < new Date([...this.rows.values()].at(-1).job.created_at) &&
      this.cursor
    )
      return; // on a later page
    this.put(data, "prepend");
    if (!known) this.paint();
  }

  fits(job) {
    const { state, tag, q } = this.filter;
    return (
      (!state || statesOf(state).includes(job.state)) &&
      (!tag || job.tags.includes(tag)) &&
      (!q || `${job.name} ${job.id}`.toLowerCase().includes(q.toLowerCase()))
    );
  }

  drop(id) {
    this.rows.get(id)?.element.remove();
    this.rows.delete(id);
    this.selected.delete(id);
    this.paint();
  }

  async act(job, name) {
    const answer = await act(job, name);
    if (answer) this.onEvent("job", answer);
  }

  select(id, on) {
    if (on) this.selected.add(id);
    else this.selected.delete(id);
    this.paintBar();
  }

  paintBar() {
    const n = this.selected.size;
    this.bar.hidden = n === 0;
    if (n)
      fill(
        this.bar,
        h("span", null, `${n} selected`),
        h("a", { class: "button primary small", href: `#/compare?jobs=${[...this.selected].join(",")}` }, "Compare"),
        h(
          "button",
          {
            class: "ghost small",
            onclick: () => {
              this.selected.clear();
              for (const r of this.rows.values()) r.check.checked = false;
              this.paintBar();
            },
          },
          "Clear",
        ),
      );
  }

  onKey(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    if (event.key === "Escape" && document.activeElement === this.search) {
      this.search.blur();
      return;
    }
    if (isTyping(event)) return;
    const links = [...this.body.querySelectorAll(".name > a")];
    const at = links.findIndex((a) => a.closest("tr").contains(document.activeElement));
    if (event.key === "/") {
      event.preventDefault();
      this.search.focus();
    } else if ((event.key === "j" || event.key === "k") && links.length) {
      event.preventDefault();
      links[Math.max(0, Math.min(links.length - 1, at < 0 ? 0 : at + (event.key === "j" ? 1 : -1)))].focus();
    } else if (event.key === "x" && at >= 0) {
      const box = links[at].closest("tr").querySelector("input");
      box.checked = !box.checked;
      this.select(links[at].closest("tr").dataset.job, box.checked);
    }
  }
}

/** Show the page in `root`. */
export async function mount(root, context) {
  const view = new JobsView(root, context);
  await view.start();
  return { destroy: () => view.destroy(), update: (where) => view.update(where) };
}
