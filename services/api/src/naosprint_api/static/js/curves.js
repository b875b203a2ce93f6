/**
 * Learning curves: the options of their charts, made from descriptions, shared by the pages of jobs, policies and the
 * comparison.
 */

import { PALETTE } from "./charts.js";
import { compact, duration, metricText, shownUnit } from "./format.js";

/** Groups of charts on a job's page, with their headings. */
export const GROUPS = [
  ["task", "Task"],
  ["learning", "Learning"],
  ["pace", "Pace"],
];

/** The two things a curve can be drawn over. */
export const X_AXES = {
  step: { label: "Steps", column: (m) => m.step, format: compact },
  time: { label: "Training time", column: (m) => m.get("time_s"), format: duration },
};

/**
 * Wall clock of each row of metrics, in seconds since 1970.
 *
 * Rows have the time of training, which stands still while a job waits or is paused. Each attempt begins with an event
 * that has its first step, so a row is as much later than its attempt's beginning as it has trained longer.
 *
 * @param {import("./columns.js").Columns} metrics
 * @param {{kind: string, at: string, data: {step?: number}}[]} events oldest first
 */
export function wallClock(metrics, events) {
  const begins = events
    .filter((e) => (e.kind === "started" || e.kind === "resumed") && e.data?.step !== undefined)
    .map((e) => ({ step: e.data.step, at: new Date(e.at).getTime() / 1000 }));
  const trained = metrics.get("time_s");
  let before = 0;
  let attempt = -1;
  let offset = 0;
  return metrics.step.map((step, i) => {
    while (attempt + 1 < begins.length && begins[attempt + 1].step < step) {
      attempt += 1;
      offset = begins[attempt].at - before;
    }
    before = trained[i] ?? before;
    return offset + before;
  });
}

/** Options of a chart about one of `Descriptions.charts`; `index` chooses the colour. */
export function chartOptions(chart, index = 0) {
  const [first] = chart.metrics;
  const share = first.unit === "%";
  const token = PALETTE[index % PALETTE.length];
  return {
    key: chart.key,
    title: chart.title,
    unit: share ? undefined : shownUnit(first),
    refs: chart.refs,
    token,
    ...(share ? { min: 0, max: 1, axisFormat: (v, more) => `${metricText({ ...first, digits: 0 }, v, more)} %` } : {}),
    ...(chart.metrics.length > 1
      ? { lines: chart.metrics.map((m, i) => [m.name, m.title.toLowerCase(), PALETTE[(index + i) % PALETTE.length]]) }
      : {}),
    format: (v) => metricText(first, v) + (share ? " %" : ""),
  };
}
