/** Plots of a study: curves of trials, their settings and results, the Pareto front. */

import { padded } from "./charts.js";
import { s } from "./dom.js";
import { axes, path, svg } from "./figures.js";
import { compact, significant, titled } from "./format.js";
import { axisOf, metricAxis, missing, parallel, scatter } from "./plots.js";

const HEIGHT = 300;

/** A value of a metric with the digits that tell trials apart, without its unit. */
export const valueText = (metric, value) => significant(metric.unit === "%" ? 100 * value : value, 4);

/** Curves of a metric of trials: `lines` have x, y, label and token. */
export function curves(width, lines, metric) {
  const label = titled(metric);
  const points = lines.map((line) => line.x.map((x, i) => [x, line.y[i]]).filter(([, y]) => !missing(y)));
  const all = points.flat();
  if (!all.length)
    return svg(
      width,
      60,
      `${label}: no metrics yet`,
      s("text", { x: 12, y: 34 }, "No training has reported metrics yet."),
    );
  const values = all.map(([, y]) => y);
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const share = metric.unit === "%";
  const plane = axes({
    width,
    height: HEIGHT,
    x: [0, Math.max(...all.map(([x]) => x))],
    y: share ? [Math.min(0, low), Math.max(1, high)] : padded(low, high),
    xLabel: "Steps",
    yLabel: label,
    xFormat: compact,
    yFormat: (v) => valueText(metric, v),
    left: 58,
  });
  return svg(
    width,
    HEIGHT,
    `${label} of ${lines.length} trials`,
    plane.group,
    points.map((curve, i) =>
      curve.length === 1
        ? s("circle", { cx: plane.sx(curve[0][0]), cy: plane.sy(curve[0][1]), r: 3, fill: `var(${lines[i].token})` })
        : s("path", {
            d: path(curve.map(([x, y]) => [plane.sx(x), plane.sy(y)])),
            fill: "none",
            stroke: `var(${lines[i].token})`,
            "stroke-width": 1.75,
          }),
    ),
    lines.map((line, i) =>
      s("text", { x: plane.left + 8, y: plane.top + 14 * (i + 1), style: { fill: `var(${line.token})` } }, line.label),
    ),
  );
}

/** The complete trials as rows of plots, with the axes of their settings and of their objectives, the metrics. */
function trialRows(study, metrics) {
  const space = Object.entries(study.spec.space);
  const best = new Set(study.best);
  const trials = study.trials.filter((trial) => trial.state === "complete");
  const rows = trials.map((trial) => ({
    label: `Trial ${trial.number}: ${trial.values.map((value, i) => valueText(metrics[i], value)).join(", ")}`,
    href: trial.job_id ? `#/jobs/${trial.job_id}` : null,
    strong: best.has(trial.number),
    settings: space.map(([name]) => trial.params[name]),
    goals: trial.values,
  }));
  const values = (i) => rows.map((row) => row.goals[i]);
  const settings = space.map(([name, parameter]) => axisOf(name, [], parameter));
  return { rows, settings, goals: metrics.map((metric, i) => metricAxis(metric, values(i))) };
}

/** Parallel coordinates: one line per complete trial through its settings to its first objective. */
export function coordinates(width, study, metrics) {
  const { rows, settings, goals } = trialRows(study, metrics);
  const lines = rows.map((row) => ({ ...row, values: [...row.settings, row.goals[0]] }));
  return parallel(width, [...settings, goals[0]], lines, `Settings and ${goals[0].title} of ${rows.length} trials`);
}

/** The first two objectives of the complete trials against each other; those of the Pareto front stand out. */
export function front(width, study, metrics) {
  const { rows, goals } = trialRows(study, metrics);
  const points = rows.map((row) => ({ ...row, values: row.goals }));
  const titles = `${goals[0].title} and ${goals[1].title}`;
  return scatter(width, goals, points, `${titles} of ${rows.length} trials, ${study.best.length} on the Pareto front`);
}
