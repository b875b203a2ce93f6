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
    ...(share ? { min: 0, max: 1, axisFormat: (v) => `${Math.round(v * 100)} %` } : {}),
    ...(chart.metrics.length > 1
      ? { lines: chart.metrics.map((m, i) => [m.name, m.title.toLowerCase(), PALETTE[(index + i) % PALETTE.length]]) }
      : {}),
    format: (v) => metricText(first, v) + (share ? " %" : ""),
  };
}
