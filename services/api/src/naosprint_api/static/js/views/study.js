/** One study: its trials, their curves, and how settings affect the objectives. */

import { call } from "../api.js";
import { PALETTE } from "../charts.js";
import { confirmDialog, fill, h, heading, scroller, table } from "../dom.js";
import { Figure } from "../figures.js";
import { percent, significant, words } from "../format.js";
import { coordinates, curves, front } from "../study-figures.js";
import { loading, notice, problem } from "./messages.js";

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

/** A study's or a trial's state as a badge. */
export const studyBadge = (state) =>
  h("span", { class: "state", "data-tone": TONES[state] ?? "grey", "data-state": state }, words(state));

/** Complete trials, the best in the first objective first. */
function ranking(study) {
  const factor = study.spec.objectives[0].direction === "maximize" ? -1 : 1;
  return study.trials
    .filter((trial) => trial.state === "complete")
    .sort((a, b) => factor * (a.values[0] - b.values[0]) || a.number - b.number);
}

/** A setting's value as text. */
const valueText = (value) =>
  typeof value === "number" && !Number.isInteger(value)
    ? significant(value, 4)
    : Array.isArray(value)
      ? value.join(", ")
      : String(value);

function trialTable(study) {
  const goals = study.spec.objectives.map((goal) => goal.metric);
  const names = Object.keys(study.spec.space);
  const ranked = ranking(study);
  const rows = [...ranked, ...study.trials.filter((trial) => !ranked.includes(trial))];
  return scroller(
    "Trials",
    table(
      [heading("Trial"), heading("State"), [...goals, ...names].map((name) => heading(name, true)), heading("Note")],
      rows.map((trial) =>
        h(
          "tr",
          { "data-trial": trial.number },
          h(
            "td",
            null,
            trial.job_id
              ? h("a", { href: `#/jobs/${trial.job_id}` }, `Trial ${trial.number}`)
              : `Trial ${trial.number}`,
            study.best.includes(trial.number) ? h("span", { class: "tag" }, "best") : null,
          ),
          h("td", null, studyBadge(trial.state)),
          goals.map((_, i) => h("td", { class: "num" }, trial.values ? significant(trial.values[i], 4) : "–")),
          names.map((name) => h("td", { class: "num" }, name in trial.params ? valueText(trial.params[name]) : "–")),
          h("td", { class: "soft" }, trial.error ?? ""),
        ),
      ),
    ),
  );
}

function importanceTable(study) {
  const goals = Object.keys(study.importance);
  if (!goals.length) return null;
  return h(
    "section",
    { class: "card", "data-part": "importance" },
    h("div", { class: "card-head" }, h("h2", null, "Importance of the settings")),
    scroller(
      "Importance",
      table(
        ["Setting", ...goals].map((title, i) => heading(title, i > 0)),
        Object.keys(study.spec.space).map((name) =>
          h(
            "tr",
            null,
            h("th", { scope: "row" }, name),
            goals.map((goal) => h("td", { class: "num" }, percent(study.importance[goal][name], 0))),
          ),
        ),
      ),
    ),
  );
}

const figureCard = (title, part, figure) =>
  h(
    "section",
    { class: "card", "data-part": part },
    h("div", { class: "card-head" }, h("h2", null, title)),
    figure.element,
  );

/** Show the page in `root`. */
export async function mount(root, { id, signal }) {
  document.title = "Study · naosprint";
  const box = h("div", null, loading("Loading the study"));
  fill(root, box);
  let figures = [];
  let shown = "";
  const histories = new Map();

  /** Curves of the best and the open trials over their steps. */
  async function load(study, metric) {
    const open = study.trials.filter((trial) => trial.state === "running");
    const wanted = [...ranking(study), ...open].filter((trial) => trial.job_id).slice(0, MOST_CURVES);
    await Promise.all(
      wanted.map(async (trial) => {
        if (histories.get(trial.number)?.final) return;
        const { columns } = await call(`jobs/${trial.job_id}/metrics?max_points=300`, { signal });
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

  async function cancel(study) {
    const sure = await confirmDialog({
      title: "Cancel the study?",
      body: "Its open jobs are cancelled, too.",
      action: "Cancel the study",
      danger: true,
    });
    if (!sure) return;
    await call(`studies/${study.id}/cancel`, { method: "POST" });
    await draw();
  }

  function paint(study, lines, metric) {
    for (const figure of figures) figure.destroy();
    const ended = study.trials.filter((trial) => trial.state !== "running").length;
    const goals = study.spec.objectives;
    const parts = [];
    if (!study.spec.elsewhere)
      parts.push([
        `Curves of the best trials: ${words(metric)}`,
        "curves",
        (width) => curves(width, lines, words(metric)),
      ]);
    if (ranking(study).length)
      parts.push(["Settings and results", "coordinates", (width) => coordinates(width, study)]);
    if (goals.length > 1 && ranking(study).length)
      parts.push(["Pareto front", "front", (width) => front(width, study)]);
    figures = parts.map(([, , drawing]) => new Figure(drawing));
    document.title = `${study.name} · naosprint`;
    fill(
      box,
      h(
        "div",
        { class: "page-head" },
        h(
          "div",
          { class: "grow" },
          h("h1", null, study.name),
          h(
            "p",
            { class: "soft" },
            `${goals.map((goal) => `${words(goal.direction)} ${goal.metric}`).join(", ")} · ${ended} of ${study.spec.trials} trials have ended`,
          ),
        ),
        studyBadge(study.state),
        study.state === "running" ? h("button", { onclick: () => cancel(study) }, "Cancel") : null,
      ),
      study.error ? notice("error", "The study failed", study.error) : null,
      parts.map(([title, part], i) => figureCard(title, part, figures[i])),
      importanceTable(study),
      h(
        "section",
        { class: "card", "data-part": "trials" },
        h("div", { class: "card-head" }, h("h2", null, "Trials")),
        trialTable(study),
      ),
    );
  }

  async function draw() {
    try {
      const study = await call(`studies/${id}`, { signal });
      const live = study.trials.some((trial) => trial.state === "running");
      const text = JSON.stringify(study);
      if (text === shown && !live) return study;
      shown = text;
      const metric = study.spec.pruning.metric ?? "reward";
      paint(study, await load(study, metric), metric);
      return study;
    } catch (error) {
      if (error.name !== "AbortError") fill(box, problem(error, draw));
      return null;
    }
  }

  await draw();
  const timer = setInterval(async () => {
    if (document.hidden) return;
    const study = await draw();
    if (study && study.state !== "running") clearInterval(timer);
  }, REFRESH_MS);
  return {
    destroy() {
      clearInterval(timer);
      for (const figure of figures) figure.destroy();
    },
  };
}
