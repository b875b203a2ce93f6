/** One study: its trials, their curves, and how settings affect the objectives. */

import { call, may } from "../api.js";
import { PALETTE } from "../charts.js";
import { descriptions, plain } from "../descriptions.js";
import { fill, h, heading, icon, scroller, table, toast } from "../dom.js";
import { Figure } from "../figures.js";
import { percent, significant, titled, words } from "../format.js";
import { coordinates, curves, front, valueText } from "../study-figures.js";
import { action, complain, field, open } from "./dialog.js";
import { live, loading, notice } from "./messages.js";

const TONES = {
  running: "blue",
  finished: "green",
  complete: "green",
  failed: "red",
  pruned: "grey",
  cancelled: "grey",
};
/** Trials whose curves are drawn. */
const MOST_CURVES = 5;
const REFRESH_MS = 5000;
const MOST_TRIALS = 1000;

/** A study's or a trial's state as a badge. */
export const studyBadge = (state) =>
  h("span", { class: "state", "data-tone": TONES[state] ?? "grey", "data-state": state }, words(state));

/** Title of what is measured in a study's trials; names of those that run elsewhere are kept. */
const described = ({ spec, job }, known, name) =>
  spec.elsewhere ? { ...plain(name), title: name } : known.measured(job.spec, name);

/** What a study optimizes: "minimize falls, maximize speed". */
export const objectives = (study, known) =>
  study.spec.objectives
    .map(({ direction, metric }) => `${words(direction)} ${described(study, known, metric).title}`)
    .join(", ");

/** Complete trials, the best in the first objective first. */
function ranking(study) {
  const factor = study.spec.objectives[0].direction === "maximize" ? -1 : 1;
  return study.trials
    .filter((trial) => trial.state === "complete")
    .sort((a, b) => factor * (a.values[0] - b.values[0]) || a.number - b.number);
}

/** A setting's value as text. */
const settingText = (value) =>
  typeof value === "number" && !Number.isInteger(value)
    ? significant(value, 4)
    : Array.isArray(value)
      ? value.join(", ")
      : String(value);

function trialTable(study, goals) {
  const names = Object.keys(study.spec.space);
  const ranked = ranking(study);
  const rows = [...ranked, ...study.trials.filter((trial) => !ranked.includes(trial))];
  return scroller(
    "Trials",
    table(
      [
        heading("Trial"),
        heading("State"),
        [...goals.map(titled), ...names].map((name) => heading(name, true)),
        heading("Note"),
      ],
      rows.map((trial) =>
        h(
          "tr",
          { "data-trial": trial.number },
          h(
            "td",
            { class: "nowrap" },
            trial.job_id
              ? h("a", { href: `#/jobs/${trial.job_id}` }, `Trial ${trial.number}`)
              : `Trial ${trial.number}`,
            study.best.includes(trial.number) ? [" ", h("span", { class: "tag" }, "best")] : null,
          ),
          h("td", null, studyBadge(trial.state)),
          goals.map((goal, i) => h("td", { class: "num" }, valueText(goal, trial.values?.[i]))),
          names.map((name) => h("td", { class: "num" }, name in trial.params ? settingText(trial.params[name]) : "–")),
          h("td", { class: "soft" }, trial.error ?? ""),
        ),
      ),
    ),
  );
}

function importanceTable(study, metrics) {
  const goals = metrics.filter(({ name }) => name in study.importance);
  if (!goals.length) return null;
  return h(
    "section",
    { class: "card", "data-part": "importance" },
    h("div", { class: "card-head" }, h("h2", null, "Importance of the settings")),
    scroller(
      "Importance",
      table(
        ["Setting", ...goals.map((goal) => goal.title)].map((title, i) => heading(title, i > 0)),
        Object.keys(study.spec.space).map((name) =>
          h(
            "tr",
            null,
            h("th", { scope: "row" }, name),
            goals.map((goal) => h("td", { class: "num" }, percent(study.importance[goal.name][name], 0))),
          ),
        ),
      ),
    ),
  );
}

/** Show the page in `root`. */
export async function mount(root, { id, signal, go }) {
  document.title = "Study · naosprint";
  const head = h("div", { class: "page-head" }, loading("Loading the study"));
  const body = h("div", { class: "stack" });
  fill(root, head, body);
  const known = await descriptions();
  const plots = new Map();
  const histories = new Map();
  let shown = "";
  let study = null;

  /** Curves of the best and the open trials over their steps. */
  async function load(metric) {
    const open = study.trials.filter((trial) => trial.state === "running");
    const wanted = [...ranking(study), ...open].filter((trial) => trial.job_id).slice(0, MOST_CURVES);
    await Promise.all(
      wanted.map(async (trial) => {
        if (histories.get(trial.number)?.final) return;
        const path = `jobs/${trial.job_id}/metrics?max_points=300`;
        const { columns } = await call(path, { signal }).catch((error) => {
          if (error.status === 404) return { columns: {} }; // the job, not the study, was deleted since
          throw error;
        });
        histories.set(trial.number, {
          final: trial.state !== "running",
          x: columns.step ?? [],
          y: columns[metric] ?? [],
        });
      }),
    );
    return wanted.map((trial, i) => ({
      label: `Trial ${trial.number}`,
      token: PALETTE[i % PALETTE.length],
      ...histories.get(trial.number),
    }));
  }

  const gone = () => {
    toast(`${study.name} was deleted.`);
    go("/studies");
  };

  /** Ask for the number of trials in all. */
  function extend() {
    const started = study.trials.length;
    const trials = h("input", {
      id: "study-trials",
      type: "number",
      min: started + 1,
      max: MOST_TRIALS,
      value: Math.min(MOST_TRIALS, Math.max(started, study.spec.trials) + 10),
      required: true,
    });
    const trouble = h("p", { class: "problem", role: "alert" });
    const submit = async (event) => {
      event.preventDefault();
      try {
        await call(`studies/${id}/extend`, { method: "POST", body: { trials: Number(trials.value) } });
        dialog.close();
        await again();
      } catch (error) {
        complain(trouble, error);
      }
    };
    const hint = `It has started ${started} of ${study.spec.trials}. A study that has ended runs again.`;
    const dialog = open(
      `Extend ${study.name}`,
      h(
        "form",
        { class: "stack", onsubmit: submit },
        field("Trials in all", trials, hint),
        trouble,
        h(
          "div",
          { class: "row end" },
          h("button", { type: "button", onclick: () => dialog.close() }, "Back"),
          h("button", { class: "primary", type: "submit" }, "Extend"),
        ),
      ),
    );
  }

  const buttons = () => [
    h("button", { "data-action": "extend", onclick: extend }, icon("plus"), "Extend"),
    study.state === "running"
      ? action("cancel", "Cancel", "close", `studies/${id}/cancel`, {
          question: {
            title: "Cancel the study?",
            body: "Its open jobs are cancelled, too.",
            action: "Cancel the study",
          },
          after: () => again(),
        })
      : action("delete", "Delete", "trash", `studies/${id}`, {
          method: "DELETE",
          question: {
            title: `Delete ${study.name}?`,
            body: "Its trials and their results are deleted; its jobs stay. This cannot be undone.",
            action: "Delete study",
          },
          after: (done) => (done ? gone() : again()),
        }),
  ];

  /** The card of a plot; it is the same one when the page is painted again, so that the page keeps its height. */
  function plot([title, part, draw]) {
    if (!plots.has(part)) {
      const figure = new Figure(draw);
      const head = h("div", { class: "card-head" }, h("h2", null, title));
      const card = h("section", { class: "card", "data-part": part }, head, scroller(title, figure.element));
      plots.set(part, { figure, card });
    }
    const { figure, card } = plots.get(part);
    figure.draw = draw;
    figure.redraw();
    return card;
  }

  function paint(lines, metric, goals) {
    const ended = study.trials.filter((trial) => trial.state !== "running").length;
    const complete = ranking(study).length > 0;
    const parts = [];
    if (!study.spec.elsewhere)
      parts.push([`Curves of the best trials: ${metric.title}`, "curves", (width) => curves(width, lines, metric)]);
    if (complete) parts.push(["Settings and results", "coordinates", (width) => coordinates(width, study, goals)]);
    if (complete && goals.length > 1) parts.push(["Pareto front", "front", (width) => front(width, study, goals)]);
    document.title = `${study.name} · naosprint`;
    fill(
      head,
      h(
        "div",
        { class: "grow" },
        h("h1", null, study.name),
        h("p", { class: "soft" }, `${objectives(study, known)} · ${ended} of ${study.spec.trials} trials have ended`),
      ),
      studyBadge(study.state),
      may("submit") ? buttons() : null,
    );
    fill(
      body,
      study.error ? notice("error", "The study failed", study.error) : null,
      parts.map(plot),
      importanceTable(study, goals),
      h(
        "section",
        { class: "card", "data-part": "trials" },
        h("div", { class: "card-head" }, h("h2", null, "Trials")),
        trialTable(study, goals),
      ),
    );
  }

  async function read() {
    study = await call(`studies/${id}`, { signal });
    const describe = (name) => described(study, known, name);
    const metric = describe(study.spec.pruning.metric ?? "reward");
    const lines = await load(metric.name);
    const text = JSON.stringify([study, lines]);
    if (text !== shown)
      paint(
        lines,
        metric,
        study.spec.objectives.map((goal) => describe(goal.metric)),
      );
    shown = text;
    return [study, ...study.trials].some(({ state }) => state === "running");
  }

  const again = await live(head, read, REFRESH_MS, signal, gone);
  return {
    destroy() {
      for (const { figure } of plots.values()) figure.destroy();
    },
  };
}
