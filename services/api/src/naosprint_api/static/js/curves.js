/** The curves of a training: one table of what is drawn, shared by the job page and the comparison. */

import { compact, duration, fixed, integer, percent, significant } from "./format.js";

/** Speeds that others have reached with this robot, m/s. */
export const SPEED_REFS = [{ y: 2.6, label: "2.60 earlier best" }, { y: 3.91, label: "3.91 paper" }];

/** key, title (`single` where only the first of its lines is drawn), unit, value scale and format of each curve; `group` says where the job page shows it. */
export const CURVES = [
  { key: "speed_mps", group: "running", title: "Speed", unit: "m/s", min: 0, max: 4.2, refs: SPEED_REFS, format: (v) => fixed(v, 2), token: "--s1" },
  { key: "distance_m", group: "running", title: "Distance", unit: "m", min: 0, max: 29, format: (v) => fixed(v, 2), token: "--s3" },
  { key: "reward", group: "running", title: "Reward per episode", min: 0, format: (v) => significant(v, 4), token: "--s4" },
  { key: "fall_rate", group: "running", title: "Fall rate", min: 0, max: 1, format: (v) => percent(v), axisFormat: (v) => `${Math.round(v * 100)} %`, token: "--s6" },
  { key: "policy_loss", group: "learning", title: "Policy loss", format: (v) => significant(v), axisFormat: (v) => significant(v, 2), token: "--s1" },
  { key: "value_loss", group: "learning", title: "Value loss", format: (v) => significant(v), axisFormat: (v) => significant(v, 2), token: "--s1" },
  { key: "approx_kl", group: "learning", title: "Approximate KL", min: 0, format: (v) => significant(v), axisFormat: (v) => significant(v, 2), token: "--s1" },
  { key: "clip_fraction", group: "learning", title: "Clip fraction", min: 0, format: (v) => percent(v), axisFormat: (v) => `${Math.round(v * 100)} %`, token: "--s1" },
  { key: "entropy", group: "learning", title: "Entropy", format: (v) => fixed(v, 2), token: "--s1" },
  { key: "explained_variance", group: "learning", title: "Explained variance", max: 1, format: (v) => fixed(v, 3), axisFormat: (v) => significant(v, 2), token: "--s1" },
  { key: "steps_per_s", group: "pace", title: "Steps per second", min: 0, format: integer, token: "--s7" },
  { key: "collect_s", group: "pace", title: "Update time", single: "Collect time per update", unit: "s", min: 0, lines: [["collect_s", "collect", "--s7"], ["learn_s", "learn", "--s2"]], format: (v) => fixed(v, 2), token: "--s7" },
  { key: "episode_length", group: "pace", title: "Episode length", unit: "steps", min: 0, format: (v) => fixed(v, 0), token: "--s7" },
];

export const GROUPS = [["running", "Running"], ["learning", "Learning"], ["pace", "Pace"]];

/** Reference lines of a curve for a task: the distance gets the finish line where there is one. */
export function refsOf(curve, task) {
  if (curve.key === "distance_m" && task?.startsWith("sprint1")) return [{ y: 28, label: "28 m finish" }];
  return curve.refs ?? [];
}

/** The two things a curve can be drawn over. */
export const X_AXES = {
  step: { label: "Steps", column: (m) => m.step, format: compact },
  time: { label: "Training time", column: (m) => m.get("time_s"), format: duration },
};
