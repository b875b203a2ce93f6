/** Loading, empty and error states, each with what to do next. */

import { ApiError, OfflineError } from "../api.js";
import { fill, h, icon } from "../dom.js";

/** Fill `box` with what `read` resolves to, again every `every` milliseconds if given; failures can be tried again. */
export async function refreshed(box, read, every) {
  const draw = async () => {
    try {
      fill(box, await read());
    } catch (error) {
      if (error.name !== "AbortError") fill(box, problem(error, draw));
    }
  };
  await draw();
  const timer = every && setInterval(draw, every);
  return { destroy: () => clearInterval(timer) };
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

/** A short notice inside a page. */
export const notice = (kind, title, text, ...extra) =>
  h(
    "div",
    { class: ["notice", kind], role: kind === "error" ? "alert" : null },
    h("div", { class: "grow" }, h("strong", null, title), text ? " " : null, text),
    ...extra,
  );
