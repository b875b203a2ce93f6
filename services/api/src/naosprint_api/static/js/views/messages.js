/** Loading, empty and error states, each with what to do next. */

import { ApiError, first, OfflineError } from "../api.js";
import { fill, h, icon } from "../dom.js";
import { minute } from "../format.js";

/**
 * Keep a page current until `signal` aborts: `read` is called every `every` milliseconds while it resolves to true and
 * the page can be seen, and whenever the window gets the focus. Resolves to a function that reads at once.
 *
 * @param {Element} box where a failure of the first read is shown; a later one is shown above it, and its content stays
 * @param {() => Promise<boolean>} read draws the page
 * @param {number} every
 * @param {AbortSignal} signal
 * @param {() => void} gone called when what was shown does not exist any more
 */
export async function live(box, read, every, signal, gone) {
  const trouble = h("div", { class: "trouble" });
  box.before(trouble);
  let found = false;
  let timer;
  let turn = Promise.resolve();
  const step = async () => {
    let open = true;
    try {
      if (!found || !document.hidden) {
        open = await read();
        found = true;
        fill(trouble);
      }
    } catch (error) {
      if (signal.aborted) return;
      open = error.status !== 404;
      if (!found) fill(box, problem(error, again));
      else if (!open) gone();
      else if (trouble.dataset.reason !== error.message || !trouble.firstChild)
        fill(trouble, notice("warn", "This page is not up to date.", `${error.message} It is read again soon.`));
      trouble.dataset.reason = error.message;
    }
    clearTimeout(timer);
    if (open && !signal.aborted) timer = setTimeout(again, every);
  };
  const again = () => {
    turn = turn.then(step); // one after the other, so that no older answer replaces a newer one
    return turn;
  };
  addEventListener("focus", again, { signal });
  signal.addEventListener("abort", () => clearTimeout(timer));
  await again();
  return again;
}

/** Fill `box` with what `read` resolves to, again every `every` milliseconds. */
export const refreshed = (box, read, every, signal) =>
  live(
    box,
    async () => {
      fill(box, await read());
      return true;
    },
    every,
    signal,
  );

/** Items of a list that are read at a time. */
const PAGE = 100;

/** Like `refreshed`, with what `draw` makes of the newest items of a list that has pages; a button adds older ones. */
export async function listed(box, path, draw, every, signal) {
  let most = PAGE;
  const read = async () => {
    const { items, more } = await first(most, path, { signal });
    const drawn = await draw(items);
    const add = (event) => {
      event.target.disabled = true;
      most += PAGE;
      again();
    };
    const older = h("button", { class: "small", "data-action": "older", onclick: add }, "Show older ones");
    const words = h("span", { class: "muted" }, `The newest ${items.length} are shown.`);
    return [drawn, more ? h("div", { class: "row wrap pad" }, words, older) : null];
  };
  const again = await refreshed(box, read, every, signal);
}

/** Grey lines while something loads. */
export const loading = (label = "Loading") =>
  h("div", { class: "loading", role: "status", "aria-label": label }, h("span"), h("span"), h("span"), h("span"));

/** Show what went wrong and how to continue. */
export function problem(error, retry) {
  let title = "Something went wrong";
  let text = error.message;
  let hint = null;
  if (error instanceof OfflineError) {
    title = "The service does not answer";
    text = "Check that it runs. On one machine, ";
    hint = [
      h("code", null, "naoctl up"),
      " starts it and ",
      h("code", null, "naoctl doctor"),
      " finds out what is wrong.",
    ];
  } else if (error instanceof ApiError) {
    if (error.status === 404) title = "Not found";
    else if (error.status === 403) title = "Not allowed";
    else if (error.status === 429) title = "Too many requests";
    else if (error.status >= 500) {
      title = "The service failed";
      text = `${error.message} (status ${error.status}).`;
    }
    if (!/[.!?]$/.test(text)) text += ".";
    if (error.requestId) hint = [" Request ", h("code", null, error.requestId), "."];
  }
  return h(
    "div",
    { class: "card empty", role: "alert" },
    h("h1", null, title),
    h("p", null, text, hint),
    h(
      "div",
      { class: "row" },
      retry ? h("button", { class: "primary", onclick: retry }, icon("retry"), "Try again") : null,
      h("a", { class: "button", href: "#/" }, "All jobs"),
    ),
  );
}

/** What queued work waits for; null for other work. */
export function waiting({ state, waiting_reason: reason, not_before: time }) {
  if (state !== "queued" || !reason) return null;
  const later = time && new Date(time) > Date.now();
  const local = reason.replace(/^(it is to start at ).*? UTC/, `$1${minute(time)}`);
  const text = `${local[0].toUpperCase()}${local.slice(1)}.`;
  return notice("warn", later ? "Waiting for its time." : "Waiting for a worker.", text);
}

/** A short notice inside a page. */
export const notice = (kind, title, text, ...extra) =>
  h(
    "div",
    { class: ["notice", kind], role: kind === "error" ? "alert" : null },
    h("div", { class: "grow" }, h("strong", null, title), text ? " " : null, text),
    ...extra,
  );
