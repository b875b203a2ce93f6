/** Light, dark or the system's theme; listeners are called when the colours change. */

const KEY = "naosprint.theme";
const listeners = new Set();
const media = matchMedia("(prefers-color-scheme: dark)");

export const theme = () => document.documentElement.dataset.theme ?? "auto";

/** Set "light", "dark" or "auto" and remember it. */
export function setTheme(value) {
  show(value);
  try {
    if (value === "auto") localStorage.removeItem(KEY);
    else localStorage.setItem(KEY, value);
  } catch {
    /* storage refused: lasts for this page */
  }
}

function show(value) {
  if (value === "auto") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = value;
  notify();
}

// Paper is white, and browsers leave out backgrounds: in the dark theme text would be light on it.
let onScreen = null;
addEventListener("beforeprint", () => {
  onScreen ??= theme(); // browsers may announce a print twice
  show("light");
});
addEventListener("afterprint", () => {
  show(onScreen ?? theme());
  onScreen = null;
});

/** Call `listener` whenever colours change; returns a function that removes it. */
export function onTheme(listener) {
  listeners.add(listener);
  return () => listeners.delete(listener);
}

let cache = new Map();
/** Return the current value of a CSS custom property, e.g. `color("--blue")`. */
export function color(name) {
  if (!cache.has(name)) cache.set(name, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  return cache.get(name);
}

function notify() {
  cache = new Map();
  for (const listener of listeners) listener();
}
media.addEventListener("change", notify);
