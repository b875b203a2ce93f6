/** Actions on jobs, values derived from them, and their summaries. */

import { call } from "./api.js";
import { nameOf } from "./descriptions.js";
import { busy, confirmDialog, toast } from "./dom.js";
import { isEnded } from "./states.js";

/** The newer of two states of a job; answers and the stream arrive in any order. */
export const newer = (held, given) => (held && held.updated_at > given.updated_at ? held : given);

/** Newest metrics row of a job, or an empty one. */
export const latest = (job) => job.latest_metrics ?? {};

/** The evaluation that an ended job shows; null for others, which show their training. */
export const evaluated = (job) => (isEnded(job.state) && job.result) || null;

/** Value of a metric in a job's list and tiles: from the evaluation, else from training. */
export function shownMetric(job, metric) {
  const found = evaluated(job)?.results.find((r) => r.name === metric.name);
  return found
    ? { value: found.value, interval: found.interval, training: false }
    : { value: latest(job)[metric.name], interval: null, training: true };
}

/** What a job has under a name: a setting such as "algorithm.gamma", else a result, a metric or a field; or null. */
export function valueIn(job, name) {
  const setting = name.split(".").reduce((value, part) => value?.[part], job.spec);
  if (setting !== undefined && setting !== null) return setting.name ?? setting;
  const result = evaluated(job)?.results.find((r) => r.name === name);
  return result?.value ?? latest(job)[name] ?? job[name] ?? null;
}

/** Names of all settings, results and metrics of these jobs, for `valueIn`. */
export function namesOf(jobs) {
  const names = new Set();
  const add = (value, path) => {
    if (value !== null && typeof value === "object" && !Array.isArray(value))
      for (const [key, inner] of Object.entries(value)) add(inner, [...path, key]);
    else if (path.at(-1) !== "version") names.add(path.at(-1) === "name" ? path[0] : path.join("."));
  };
  for (const job of jobs) {
    add(job.spec, []);
    for (const { name } of job.result?.results ?? []) names.add(name);
    for (const name of Object.keys(latest(job))) names.add(name);
  }
  return [...names].sort();
}

/** Share of the steps that are done, 0 to 1. */
export const progress = (job) => (job.total_steps > 0 ? Math.min(1, job.progress_step / job.total_steps) : 0);

/** Seconds that the job has run, or null before its start. */
export function elapsed(job) {
  if (!job.started_at) return null;
  const end = job.finished_at ? new Date(job.finished_at) : Date.now();
  return Math.max(0, (end - new Date(job.started_at)) / 1000);
}

/**
 * Seconds that workers spent on the job, from its events; time in the queue and pauses do not count. Null before
 * its start.
 *
 * @param {object} job
 * @param {{kind: string, at: string}[]} events oldest first
 */
export function worked(job, events) {
  const busy = new Set(["claimed", "starting", "running", "pausing", "evaluating"]);
  const idle = new Set(["queued", "paused", "succeeded", "failed", "cancelled"]);
  let total = 0;
  let since = null;
  for (const { kind, at } of events) {
    const time = new Date(at).getTime() / 1000;
    if (busy.has(kind)) since ??= time;
    else if (idle.has(kind) && since !== null) {
      total += time - since;
      since = null;
    }
  }
  if (since !== null) total += Math.max(0, (job.finished_at ? new Date(job.finished_at) : Date.now()) / 1000 - since);
  return events.some((e) => busy.has(e.kind)) ? total : elapsed(job);
}

/** Estimated seconds until the training ends; null when not training. */
export const remaining = (job) => (job.state === "running" ? (latest(job).eta_s ?? null) : null);

/** Task, preset, robot and, unless it is the usual one, the simulator: "run · fast · nao-0". */
export const summary = ({ spec }) =>
  [
    nameOf(spec, "task"),
    spec.algorithm?.preset,
    nameOf(spec, "robot"),
    nameOf(spec, "simulator") === "embedded" ? null : nameOf(spec, "simulator"),
  ]
    .filter((part) => part && part !== "?")
    .join(" · ");

const QUESTIONS = {
  cancel: (job) => ({
    title: `Cancel ${job.name}?`,
    body: "The training stops at once. Checkpoints and metrics so far are kept, and the job can be retried from its last checkpoint.",
    action: "Cancel job",
    danger: true,
  }),
  delete: (job) => ({
    title: `Delete ${job.name}?`,
    body: "Its metrics, log, checkpoints and evaluations are deleted. This cannot be undone.",
    action: "Delete job",
    danger: true,
  }),
};
const DONE = {
  pause: "will pause at its next checkpoint",
  resume: "is queued again",
  retry: "is queued again",
  cancel: "is being cancelled",
  delete: "was deleted",
};

/**
 * Request an action of the service with a button, after a confirmation where work would be lost. Resolves to the job's
 * new state, or null if the action was not confirmed or has failed.
 */
export async function act(job, name, button) {
  if (
    QUESTIONS[name] &&
    !(name === "cancel" && job.state === "queued" && !job.progress_step) &&
    !(await confirmDialog(QUESTIONS[name](job)))
  )
    return null;
  try {
    const path = `jobs/${encodeURIComponent(job.id)}`;
    const answer = await busy(button, () =>
      name === "delete" ? call(path, { method: "DELETE" }) : call(`${path}/${name}`, { method: "POST" }),
    );
    toast(`${job.name} ${DONE[name]}.`);
    return answer ?? job;
  } catch (error) {
    toast(`${job.name}: ${error.message}`, "error");
    return null;
  }
}
