/** Appearance and allowed actions of each job state; mirrors the service's transition table. */

import { may } from "./api.js";
import { h, icon } from "./dom.js";

/** tone, glyph and label of each state. */
export const STATES = {
  queued: { tone: "grey", glyph: "clock", label: "Queued" },
  starting: { tone: "blue", glyph: null, label: "Starting" },
  running: { tone: "blue", glyph: null, label: "Running" },
  pausing: { tone: "amber", glyph: "pause", label: "Pausing" },
  paused: { tone: "amber", glyph: "pause", label: "Paused" },
  evaluating: { tone: "violet", glyph: null, label: "Evaluating" },
  succeeded: { tone: "green", glyph: "check", label: "Succeeded" },
  failed: { tone: "red", glyph: "close", label: "Failed" },
  cancelled: { tone: "grey", glyph: "dash", label: "Cancelled" },
};

export const ACTIVE = ["queued", "starting", "running", "pausing", "paused", "evaluating"];
const ENDED = ["succeeded", "failed", "cancelled"];
export const isEnded = (state) => ENDED.includes(state);
export const tone = (state) => STATES[state]?.tone ?? "grey";

/** Name, icon and label of what a user may ask of a job now. */
export function actionsFor(job) {
  const actions = [];
  if (!may("submit")) return actions;
  if (["queued", "starting", "running"].includes(job.state) && !job.cancel_requested)
    actions.push({ name: "pause", icon: "pause", label: "Pause" });
  if (job.state === "paused") actions.push({ name: "resume", icon: "play", label: "Resume" });
  if (["failed", "cancelled"].includes(job.state)) actions.push({ name: "retry", icon: "retry", label: "Retry" });
  if (!isEnded(job.state) && !job.cancel_requested)
    actions.push({ name: "cancel", icon: "close", label: "Cancel", danger: true });
  return actions;
}

/** Return the state as a badge: glyph and word, never colour alone. */
export function stateBadge(state, note) {
  const known = STATES[state] ?? { tone: "grey", glyph: "dash", label: state };
  return h(
    "span",
    { class: "state", "data-tone": known.tone, "data-state": state },
    known.glyph ? icon(known.glyph) : h("span", { class: "pulse" }),
    note ?? known.label,
  );
}

/** Label that replaces the state's own while a request is pending or the job has stalled; undefined if neither. */
export function stateNote(job) {
  if (job.cancel_requested && !isEnded(job.state)) return "Cancelling";
  if (job.stalled_since) return "Stalled";
  return undefined;
}
