/** History of a job: attempts and events on a timeline, and its lineage. */

import { call, first, query } from "../api.js";
import { fill, h } from "../dom.js";
import { clock, day, duration, stamp, withUnit, words } from "../format.js";
import { shownMetric } from "../jobs.js";
import { isEnded, STATES, stateBadge, tone } from "../states.js";

const TONES = {
  claimed: "blue",
  checkpoint: "green",
  evaluation: "violet",
  cancel_requested: "amber",
  pause_requested: "amber",
  requeued: "amber",
  lost: "red",
};
/** Most jobs that are read of those of a group, and of those that start from a job's policy. */
const MOST_RELATED = 200;
const toneOf = (event) => (STATES[event.kind] ? tone(event.kind) : (TONES[event.kind] ?? "grey"));

export class HistoryTab {
  constructor(root, store) {
    this.store = store;
    this.spans = h("div");
    this.list = h("ol", { class: "timeline", tabindex: 0, "aria-label": "Events, newest first" });
    this.lineage = h("div", null, h("p", { class: "pad muted" }, "Loading related jobs."));
    fill(
      root,
      h(
        "div",
        { class: "two" },
        h(
          "section",
          { class: "card" },
          h("div", { class: "card-head" }, h("h2", null, "Timeline")),
          this.spans,
          this.list,
        ),
        h("section", { class: "card" }, h("div", { class: "card-head" }, h("h2", null, "Lineage")), this.lineage),
      ),
    );
    store.on("events", () => this.draw());
    this.draw();
    this.trace().catch((error) => {
      if (error.name !== "AbortError") fill(this.lineage, h("p", { class: "pad muted" }, error.message));
    });
  }

  draw() {
    if (this.gone) return;
    const { events, job } = this.store;
    if (!events.length) {
      fill(this.list, h("li", null, h("span", { class: "muted" }, "Nothing has happened yet.")));
      return;
    }
    fill(this.spans, this.bar(events, job));
    let attempt = null;
    const today = day(new Date());
    fill(
      this.list,
      events.toReversed().map((e) => {
        const mark = attempt !== null && attempt !== e.attempt;
        attempt = e.attempt;
        const known = STATES[e.kind]?.label ?? words(e.kind);
        return h(
          "li",
          { "data-tone": toneOf(e), "data-kind": e.kind, class: mark ? "first" : null },
          h("span", { class: "what" }, known, e.attempt ? h("span", { class: "unit" }, `attempt ${e.attempt}`) : null),
          h("time", { datetime: e.at, title: stamp(e.at) }, day(e.at) === today ? clock(e.at) : stamp(e.at)),
          e.message && e.message.toLowerCase() !== known.toLowerCase() ? h("span", { class: "more" }, e.message) : null,
        );
      }),
    );
  }

  /** One bar: the job's life in shares of time per state. */
  bar(events, job) {
    const turns = events
      .map((e) => [STATES[e.kind] ? e.kind : e.kind === "claimed" ? "starting" : null, new Date(e.at)])
      .filter(([state]) => state);
    if (turns.length < 2 && isEnded(job.state)) return null;
    const end = job.finished_at ? new Date(job.finished_at) : new Date();
    const spans = turns
      .map(([state, at], i) => ({ state, seconds: Math.max(0, ((turns[i + 1]?.[1] ?? end) - at) / 1000) }))
      .filter((x) => !isEnded(x.state) && x.seconds > 0);
    const sum = new Map();
    for (const x of spans) sum.set(x.state, (sum.get(x.state) ?? 0) + x.seconds);
    return h(
      "div",
      { class: "pad" },
      h(
        "div",
        {
          class: "span-bar",
          role: "img",
          "aria-label": [...sum].map(([k, v]) => `${STATES[k].label} ${duration(v)}`).join(", "),
        },
        spans.map((x) =>
          h("span", {
            "data-tone": tone(x.state),
            style: { flex: `${x.seconds} 0 0` },
            title: `${STATES[x.state].label} ${duration(x.seconds)}`,
          }),
        ),
      ),
      h(
        "div",
        { class: "legend", style: { "margin-top": "0.6rem" } },
        [...sum].map(([state, seconds]) => h("span", null, stateBadge(state), duration(seconds))),
      ),
    );
  }

  /** Ancestors, siblings of the group, and children, as a tree. */
  async trace() {
    const { store } = this;
    const get = (id) => call(`jobs/${encodeURIComponent(id)}`, { signal: store.signal });
    const chain = [store.job];
    while (chain[0].parent_job_id && chain.length < 20) {
      try {
        chain.unshift(await get(chain[0].parent_job_id));
      } catch (error) {
        if (error.status !== 404) throw error;
        break;
      }
    }
    const list = (params) => first(MOST_RELATED, "jobs", { params, signal: store.signal });
    const { items: children, more } = await list({ parent: store.id });
    const group = store.job.group_id ? await list({ group: store.job.group_id }) : { items: [] };
    if (this.gone) return;
    /** The first metric of the job's task, from its evaluation where there is one. */
    const result = (job) => {
      const [metric] = store.known.listed(job.spec);
      const shown = metric ? shownMetric(job, metric) : null;
      if (shown?.value === undefined || shown.value === null) return null;
      return h("span", { class: "muted" }, withUnit(metric, shown.value), shown.training ? " in training" : "");
    };
    const node = (job, ...kids) =>
      h(
        "li",
        null,
        h(
          "div",
          { class: "node", "aria-current": job.id === store.id ? "true" : null },
          h("a", { href: `#/jobs/${job.id}` }, job.name),
          stateBadge(job.state),
          result(job),
        ),
        kids.length ? h("ul", { class: "tree" }, kids) : null,
      );
    const tree = chain
      .slice(0, -1)
      .reduceRight((inner, job) => node(job, inner), node(store.job, ...children.map((j) => node(j))));
    fill(
      this.lineage,
      h("ul", { class: "tree" }, tree),
      chain.length === 1 && !children.length
        ? h(
            "p",
            { class: "pad muted", style: { "padding-top": 0 } },
            "It started from random weights, and no other job starts from its policy. “Continue in a new job” on a checkpoint starts one.",
          )
        : null,
      more ? h("p", { class: "pad muted" }, `The newest ${MOST_RELATED} of its jobs are shown.`) : null,
      group.items.length
        ? h(
            "div",
            { class: "pad" },
            h("h3", null, `Group of ${group.more ? "more than " : ""}${group.items.length}`),
            h("p", { class: "muted" }, "Jobs of one sweep."),
            h(
              "p",
              { style: { "margin-top": "0.6rem" } },
              h(
                "a",
                { class: "button small", href: `#/compare${query({ group: store.job.group_id })}` },
                "Compare the group",
              ),
            ),
          )
        : null,
    );
  }

  destroy() {
    this.gone = true;
  }
}
