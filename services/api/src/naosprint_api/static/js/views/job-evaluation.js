/** The evaluations of a job: headline, tables, all results, paths on the field, directions, gait. */

import { Chart } from "../charts.js";
import { descriptions } from "../descriptions.js";
import { fill, h, icon, scroller } from "../dom.js";
import { fallNote, gait, Paths, representative, requestEvaluation } from "../evaluation.js";
import { Figure, field, gaitDiagram, histogram } from "../figures.js";
import { ago, bytes, fixed, integer, percent, stamp } from "../format.js";
import { isEnded } from "../states.js";
import { fetchInto } from "./job-checkpoints.js";
import { loading, notice } from "./messages.js";
import { hasResults, headlineStats, levelOf, resultsTable, tableCards } from "./results.js";

const TONES = {
  queued: "grey",
  starting: "violet",
  running: "violet",
  succeeded: "green",
  failed: "red",
  cancelled: "grey",
};
const WINDOW_S = 2;

export class EvaluationTab {
  constructor(root, store, { sub, go }) {
    this.root = root;
    this.store = store;
    this.go = go;
    this.wanted = sub ?? null;
    this.parts = [];
    for (const topic of ["evaluations", "checkpoints"]) store.on(topic, () => this.draw());
    store.on("job", () => {
      if (!store.evaluations?.length) this.draw();
    });
    this.draw();
  }

  /** Show another evaluation of the same job. */
  update({ sub }) {
    this.wanted = sub ?? null;
    this.draw();
    return true;
  }

  draw() {
    if (this.gone) return;
    const { evaluations, job, checkpoints } = this.store;
    if (!evaluations?.length) {
      const key = JSON.stringify([isEnded(job.state), Boolean(checkpoints?.length)]);
      if (key === this.key) return;
      this.key = key;
      this.clear();
      const ask = h(
        "button",
        { class: "primary", disabled: !checkpoints?.length, onclick: () => this.ask(ask) },
        "Evaluate the newest checkpoint",
      );
      fill(
        this.root,
        h(
          "div",
          { class: "card empty" },
          h("h2", null, "Not evaluated yet"),
          h(
            "p",
            null,
            !isEnded(job.state) && job.evaluation
              ? `The final policy will run ${integer(job.evaluation.episodes)} episodes when the training ends. A checkpoint can be evaluated before that.`
              : checkpoints?.length
                ? "Run the newest policy over many episodes to measure how well it does its task."
                : "There is no checkpoint to evaluate.",
          ),
          h("div", { class: "row" }, ask),
        ),
      );
      return;
    }
    const chosen = evaluations.find((e) => e.id === this.wanted) ?? representative(evaluations) ?? evaluations[0];
    const shown = JSON.stringify([chosen.id, chosen.state, chosen.waiting_reason]);
    const key = JSON.stringify([evaluations.map((e) => [e.id, e.state]), shown, Boolean(checkpoints?.length)]);
    if (key === this.key) return;
    this.key = key;
    const steps = new Map((checkpoints ?? []).map((c) => [c.id, c.step]));
    const again = h(
      "button",
      { onclick: () => this.ask(again), disabled: !checkpoints?.length },
      "Evaluate newest checkpoint",
    );
    if (!this.list?.isConnected) {
      this.list = h("div", { class: "row wrap", style: { "margin-bottom": "1rem" } });
      fill(this.root, this.list);
      this.shown = null;
    }
    fill(
      this.list,
      evaluations.map((e) =>
        h(
          "a",
          {
            class: "button small",
            href: `#/jobs/${this.store.id}/evaluation/${e.id}`,
            "aria-current": e === chosen ? "true" : null,
            title: stamp(e.created_at),
            "data-evaluation": e.id,
            "data-episodes": e.spec.episodes,
          },
          h(
            "span",
            { class: "state", "data-tone": TONES[e.state] },
            e.state === "succeeded"
              ? icon("check")
              : e.state === "failed" || e.state === "cancelled"
                ? icon("close")
                : h("span", { class: "pulse" }),
            e.state,
          ),
          steps.has(e.checkpoint_id) ? h("span", null, `step ${integer(steps.get(e.checkpoint_id))}`) : null,
          h("span", null, `${integer(e.spec.episodes)} episodes`),
          h("span", { class: "muted" }, ago(e.created_at)),
        ),
      ),
      h("span", { style: { flex: 1 } }),
      again,
    );
    // The evaluation in view is not redrawn when others change.
    if (shown === this.shown) return;
    this.shown = shown;
    this.clear();
    this.body = h("div", { class: "stack" });
    fill(this.root, this.list, this.body);
    if (chosen.state === "failed") fill(this.body, notice("error", "This evaluation failed.", chosen.error ?? ""));
    else if (chosen.state === "cancelled") fill(this.body, notice("warn", "This evaluation was cancelled."));
    else if (chosen.state !== "succeeded")
      fill(
        this.body,
        h(
          "div",
          { class: "card empty" },
          h("h2", null, chosen.state === "queued" ? (chosen.waiting_reason ?? "Waiting for a worker") : "Running"),
          h("p", null, `${integer(chosen.spec.episodes)} episodes. The results appear here when they are done.`),
        ),
      );
    else this.show(chosen);
  }

  async ask(button) {
    const made = await requestEvaluation(this.store, button, {}, "The newest checkpoint will be evaluated.");
    if (made) this.go(`/jobs/${this.store.id}/evaluation/${made.id}`);
  }

  async show(evaluation) {
    const { body } = this;
    const known = await descriptions();
    if (this.gone || this.body !== body) return;
    const { summary } = evaluation;
    this.robot = known.robot(summary.robot);
    const level = levelOf(evaluation.spec);
    const recorded = evaluation.files.find(
      (x) => x.name === "trajectories.npz" || x.name.endsWith("/trajectories.npz"),
    );
    const box = h(
      "div",
      { class: "stack" },
      recorded
        ? h("div", { class: "card" }, loading("Loading paths"))
        : notice("info", "No paths were recorded.", "Run an evaluation with trajectories to see them."),
    );
    this.pathBox = box;
    fill(
      this.body,
      hasResults(summary)
        ? [
            h("div", { class: "stats" }, headlineStats(summary)),
            tableCards(summary, level, (draw) => this.figure(draw)),
            h(
              "details",
              { class: "card" },
              h("summary", null, "All results"),
              scroller("All results", resultsTable(known.results(summary), level)),
            ),
          ]
        : notice(
            "info",
            "This evaluation is from an earlier version.",
            "Evaluate the checkpoint again to see its results here.",
          ),
      this.pathBox,
      h(
        "section",
        { class: "card" },
        h("div", { class: "card-head" }, h("h2", null, "Files")),
        h(
          "ul",
          { class: "list" },
          evaluation.files.map((x) => {
            const get = h(
              "button",
              { class: "small", onclick: () => fetchInto(get, x.url, x.name) },
              icon("download"),
              "Download",
            );
            return h(
              "li",
              null,
              h("span", { class: "grow mono", title: `sha256 ${x.sha256}` }, x.name),
              h("span", { class: "muted" }, bytes(x.size)),
              get,
            );
          }),
        ),
      ),
    );
    if (!recorded) return;
    try {
      const lines = known.task(summary.task?.name)?.lines ?? [];
      const paths = await Paths.load(recorded, known.field(summary.robot), lines, this.store.signal);
      if (!this.gone && this.pathBox === box) this.showPaths(paths);
    } catch (error) {
      if (error.name !== "AbortError") fill(box, notice("error", "The paths could not be read.", error.message));
    }
  }

  showPaths(paths) {
    this.paths = paths;
    const episodes = paths.all();
    // Open on a typical run: the median of the distance.
    this.selected = episodes.map((e, i) => [e.distance, i]).sort((a, b) => a[0] - b[0])[
      Math.floor(episodes.length / 2)
    ][1];
    const widest = Math.max(
      ...episodes.map((e) =>
        Math.max(...[0, 0.25, 0.5, 0.75, 1].map((q) => Math.abs(e.y[Math.floor((e.samples - 1) * q)]))),
      ),
    );
    const most = paths.ground.width_m / 2 + 0.5;
    const near = Math.min(most, Math.max(3, Math.ceil(widest + 0.5)));
    this.half = near;
    const whole = h("input", {
      type: "checkbox",
      onchange: () => {
        this.half = whole.checked ? most : near;
        this.field.redraw();
      },
    });
    this.choice = h(
      "select",
      { "aria-label": "Episode", style: { width: "auto" }, onchange: () => this.select(Number(this.choice.value)) },
      episodes.map((e, i) =>
        h(
          "option",
          { value: i },
          `Episode ${i + 1}: ${fixed(e.distance, 1)} m, ${fixed(e.speed)} m/s${e.failed ? ", failed" : ""}`,
        ),
      ),
    );
    this.field = this.keep(
      new Figure((w) => field(w, paths, { selected: this.selected, half: this.half, onSelect: (i) => this.select(i) })),
    );
    this.from = 0;
    this.range = h("input", {
      type: "range",
      min: 0,
      step: 0.1,
      "aria-label": "Start of the gait diagram in seconds",
      oninput: () => {
        this.from = Number(this.range.value);
        this.gait.redraw();
      },
    });
    this.gait = this.keep(
      new Figure((w) =>
        gaitDiagram(
          w,
          paths.episode(this.selected),
          paths.cycle,
          this.from,
          Math.min(WINDOW_S, Math.max(0.2, paths.episode(this.selected).seconds)),
        ),
      ),
    );
    this.gaitFigures = h("dl", { class: "pairs" });
    const chart = (title, unit, token, extra) =>
      this.keep(
        new Chart({
          title,
          unit,
          sync: "episode",
          xFormat: (v) => `${fixed(v, 1)} s`,
          series: [{ label: title, token }],
          ...extra,
        }),
      );
    this.speed = chart("Speed", "m/s", "--s1", { min: 0 });
    this.height = chart("Torso height", "m", "--s3", {
      min: this.robot ? this.robot.standing_height_m / 2 : 0,
      format: (v) => fixed(v, 3),
      axisFormat: (v) => fixed(v, 2),
    });
    const failed = episodes.filter((e) => e.failed).length;
    fill(
      this.pathBox,
      h(
        "section",
        { class: "card" },
        h(
          "div",
          { class: "card-head" },
          h("h2", null, `Paths of ${integer(paths.count)} episodes`),
          h(
            "div",
            { class: "legend hide-tiny" },
            paths.failed
              ? [
                  h("span", null, h("i", { style: { background: "var(--s1)" } }), `finished (${paths.count - failed})`),
                  h("span", null, h("i", { style: { background: "var(--s6)" } }), `failed (${failed})`),
                ]
              : null,
          ),
          h("label", { class: "row nowrap" }, whole, "Whole field"),
        ),
        h("div", { class: "pad" }, this.field.element),
      ),
      h("div", { class: "row wrap" }, h("h2", null, "One episode"), this.choice),
      h(
        "div",
        { class: "charts four" },
        h(
          "section",
          { class: "card" },
          h(
            "div",
            { class: "card-head" },
            h("h2", null, "Gait"),
            h("div", { class: "legend" }, h("span", { class: "muted" }, "shaded: both feet off the ground")),
          ),
          h(
            "div",
            { class: "pad" },
            this.gait.element,
            h(
              "div",
              { class: "row", style: { margin: "0.3rem 0 0.9rem" } },
              h("span", { class: "muted nowrap" }, "Scroll"),
              this.range,
            ),
            this.gaitFigures,
          ),
        ),
        h("div", { class: "stack" }, this.speed.element, this.height.element),
      ),
      h(
        "div",
        { class: "charts four" },
        h(
          "section",
          { class: "card" },
          h("div", { class: "card-head" }, h("h2", null, "Angle to the mean direction")),
          h(
            "div",
            { class: "pad" },
            this.figure((w) =>
              histogram(
                w,
                episodes.map((_, i) => paths.deviation(i)),
                { label: "degrees", format: (v) => fixed(v, 1) },
              ),
            ),
          ),
        ),
        h(
          "section",
          { class: "card" },
          h("div", { class: "card-head" }, h("h2", null, "Speed of the episodes")),
          h(
            "div",
            { class: "pad" },
            this.figure((w) =>
              histogram(
                w,
                episodes.map((e) => Math.max(0, e.speed)),
                { label: "m/s, from the start", format: (v) => fixed(v, 2), token: "--s3" },
              ),
            ),
          ),
        ),
      ),
    );
    this.select(this.selected);
  }

  select(i) {
    this.selected = i;
    this.choice.value = String(i);
    const e = this.paths.episode(i);
    const { cycle } = this.paths;
    this.range.max = Math.max(0, e.seconds - WINDOW_S).toFixed(1);
    this.from = Math.min(Number(this.range.max), Math.max(0, e.seconds / 2 - 1));
    this.range.value = String(this.from);
    this.field.redraw();
    this.gait.redraw();
    const g = gait(e, cycle, Math.min(e.samples - 1, Math.round(1 / cycle)));
    const fell = fallNote(e, fixed(e.seconds));
    const pairs = [
      ...(fell ? [["Episode", fell]] : []),
      ["Steps per second", g.stepRate === null ? "–" : fixed(g.stepRate)],
      ["Stride length", g.stride === null ? "–" : `${fixed(g.stride)} m`],
      ["On the ground, left and right", `${percent(g.duty[0], 0)}, ${percent(g.duty[1], 0)}`],
      ["In flight", percent(g.flight, 0)],
    ];
    fill(
      this.gaitFigures,
      pairs.map(([k, v]) => [h("dt", null, k), h("dd", null, v)]),
    );
    const t = Array.from({ length: e.samples }, (_, k) => k * cycle);
    // Speed over a quarter of a second: one step of 20 ms shows the sway of the torso more than the run.
    const k = Math.round(0.125 / cycle);
    const speed = t.map((_, n) => {
      const a = Math.max(0, n - k);
      const b = Math.min(e.samples - 1, n + k);
      return b > a ? Math.hypot(e.x[b] - e.x[a], e.y[b] - e.y[a]) / ((b - a) * cycle) : null;
    });
    this.speed.setData([t, speed]);
    this.height.setData([t, Array.from(e.height)]);
  }

  keep(part) {
    this.parts.push(part);
    return part;
  }

  figure(draw) {
    return this.keep(new Figure(draw)).element;
  }

  clear() {
    for (const part of this.parts) part.destroy();
    this.parts = [];
  }

  destroy() {
    this.gone = true;
    this.clear();
  }
}
