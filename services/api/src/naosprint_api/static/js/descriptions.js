/**
 * Descriptions that tasks and algorithms publish: their metrics, charts and headlines. Nothing else in the dashboard
 * names a metric of a task.
 */

import { call } from "./api.js";
import { words } from "./format.js";

/** Metrics of how fast a training is, whatever it trains. */
const PACE = [
  { name: "steps_per_s", title: "Steps per second", unit: "", digits: 0, better: "higher" },
  { name: "collect_s", title: "Collection time", unit: "s", digits: 2, better: "lower" },
  { name: "simulator_s", title: "Simulator time", unit: "s", digits: 2, better: "lower" },
  { name: "learn_s", title: "Update time", unit: "s", digits: 2, better: "lower" },
  { name: "cpus", title: "Processors", unit: "", digits: 1, better: null },
  { name: "memory_mb", title: "Memory", unit: "MiB", digits: 0, better: null },
];
/** Metrics of trainings on the fast engine of T1 and K1. */
const ENGINES = [
  { name: "training_engine_reward", title: "Training engine", unit: "", digits: 2, better: "higher" },
  { name: "evaluation_engine_reward", title: "Evaluation engine", unit: "", digits: 2, better: "higher" },
  { name: "left_to_mujoco", title: "Substeps left to MuJoCo", unit: "", digits: 0, better: "lower" },
];
const ENGINE_CHARTS = [
  { group: "task", title: "Reward by engine", metrics: ["training_engine_reward", "evaluation_engine_reward"] },
  { group: "pace", title: "Substeps left to MuJoCo", metrics: ["left_to_mujoco"] },
];
/** Ground without lines and goals. */
const BARE = {
  length_m: 30,
  width_m: 20,
  line_width_m: 0,
  circle_radius_m: 0,
  lines: [],
  penalty_spot_m: 0,
  goal: null,
};
/** Columns of metrics that are no curves. */
const PROGRESS = new Set(["step", "attempt", "time_s", "episodes", "stage", "eta_s", "server_failures"]);

/** Name of the plug-in of a specification's section; a specification of an older version may have none. */
export const nameOf = (spec, section) =>
  spec?.[section]?.name ?? (typeof spec?.[section] === "string" ? spec[section] : null) ?? "?";

export class Descriptions {
  /**
   * @param {object[]} tasks answer of `GET /tasks` @param {object[]} algorithms answer of `GET /algorithms`
   * @param {object[]} robots answer of `GET /robots`
   */
  constructor(tasks = [], algorithms = [], robots = []) {
    this.tasks = new Map(tasks.map((t) => [t.name, t]));
    this.algorithms = new Map(algorithms.map((a) => [a.name, a]));
    this.robots = new Map(robots.map((r) => [r.name, r]));
  }

  /** A robot's description; null if the service does not have the robot. */
  robot(name) {
    return this.robots.get(name) ?? null;
  }

  /** The field of a robot's league; bare ground if the service does not have the robot. */
  field(name) {
    return this.robot(name)?.field ?? BARE;
  }

  /** A task's description; null if the service does not have the task. */
  task(name) {
    return this.tasks.get(name) ?? null;
  }

  /** Those metrics or references that a robot has: some are of one family of robots only. */
  ofRobot(name, known) {
    const family = this.robot(name)?.family;
    return known.filter((each) => !each.families || each.families.includes(family));
  }

  /** Results of an evaluation without those of other robots, which earlier versions reported. */
  results(summary) {
    const known = this.task(nameOf(summary, "task"))?.results ?? [];
    const shown = new Set(this.ofRobot(nameOf(summary, "robot"), known));
    const others = new Set(known.filter((metric) => !shown.has(metric)).map((metric) => metric.name));
    return summary.results.filter((result) => !others.has(result.name));
  }

  /** A result of an evaluation, or a metric of a training, by its name. */
  measured(spec, name) {
    const results = this.task(nameOf(spec, "task"))?.results ?? [];
    return results.find((result) => result.name === name) ?? this.metrics(spec).get(name) ?? plain(name);
  }

  /** All metrics of a specification by name. */
  metrics(spec) {
    const known = [
      ...(this.task(nameOf(spec, "task"))?.metrics ?? []),
      ...(this.algorithms.get(nameOf(spec, "algorithm"))?.metrics ?? []),
      ...PACE,
      ...ENGINES,
    ];
    return new Map(known.map((m) => [m.name, m]));
  }

  /** Metrics that lists show of a job, the most important first. */
  listed(spec) {
    const metrics = this.metrics(spec);
    return (this.task(nameOf(spec, "task"))?.listed ?? []).map((name) => metrics.get(name)).filter(Boolean);
  }

  /**
   * Charts of a specification, the task's first.
   *
   * @param {object} spec
   * @param {Iterable<string>} columns names of the columns that there are; those without a description get a chart
   *   each
   * @returns {{key: string, group: "task"|"learning"|"pace", title: string, metrics: object[], refs: {y: number, label:
   *   string, metric: string}[]}[]}
   */
  charts(spec, columns = []) {
    const metrics = this.metrics(spec);
    const task = this.task(nameOf(spec, "task"));
    const algorithm = this.algorithms.get(nameOf(spec, "algorithm"));
    const references = this.ofRobot(nameOf(spec, "robot"), task?.references ?? []);
    const refs = (names) =>
      references.filter((r) => names.includes(r.metric)).map((r) => ({ y: r.value, label: r.title, metric: r.metric }));
    const make = (group) => (chart) => ({
      key: chart.metrics[0],
      group,
      title: chart.title,
      metrics: chart.metrics.map((name) => metrics.get(name) ?? plain(name)),
      refs: group === "task" ? refs(chart.metrics) : [],
    });
    const present = new Set(columns);
    const described = [
      ...(task?.charts ?? []).map(make("task")),
      ...(algorithm?.charts ?? []).map(make("learning")),
      ...[
        { title: "Steps per second", metrics: ["steps_per_s"] },
        { title: "Time per update", metrics: ["collect_s", "simulator_s", "learn_s"] },
        { title: "Processors", metrics: ["cpus"] },
        { title: "Memory", metrics: ["memory_mb"] },
      ].map(make("pace")),
      ...ENGINE_CHARTS.filter((chart) => chart.metrics.some((name) => present.has(name))).map(({ group, ...chart }) =>
        make(group)(chart),
      ),
    ];
    const covered = new Set([...metrics.keys(), ...described.flatMap((c) => c.metrics.map((m) => m.name))]);
    const others = [...present]
      .filter((name) => !covered.has(name) && !PROGRESS.has(name))
      .map((name) => ({ title: words(name), metrics: [name] }));
    return [
      ...described.filter((c) => c.group === "task"),
      ...others.map(make("task")),
      ...described.filter((c) => c.group !== "task"),
    ];
  }
}

/** A metric without a description. */
export const plain = (name) => ({ name, title: words(name), unit: "", digits: null, better: null });

/** Metrics of several groups, each once: the first of each group, then the second of each, and so on. */
export function common(groups) {
  const found = new Map();
  for (let rank = 0; groups.some((g) => rank < g.length); rank++)
    for (const group of groups)
      if (group[rank] && !found.has(group[rank].name)) found.set(group[rank].name, group[rank]);
  return [...found.values()];
}

let loading = null;

/** The service's descriptions, asked for once; without an answer there are none, and names stand in for titles. */
export function descriptions() {
  loading ??= Promise.all([call("tasks"), call("algorithms"), call("robots")])
    .then((answers) => new Descriptions(...answers))
    .catch(() => {
      loading = null;
      return new Descriptions();
    });
  return loading;
}
