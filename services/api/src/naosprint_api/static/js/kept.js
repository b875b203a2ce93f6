/** What this browser keeps for its user between visits; without storage it lasts for the page. */

const held = new Map();

/** The value kept under a key, or null. */
export function read(key) {
  if (held.has(key)) return held.get(key);
  try {
    return JSON.parse(localStorage.getItem(key) ?? "null");
  } catch {
    return null;
  }
}

/** Keep a value that JSON can hold. */
export function write(key, value) {
  held.set(key, value);
  try {
    localStorage.setItem(key, JSON.stringify(value));
  } catch {
    /* storage refused */
  }
}
