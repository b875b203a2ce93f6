/** What this browser keeps for its user between visits; without storage it lasts for the page. */

/** What the storage has refused. */
const held = new Map();

/** The value kept under a key, perhaps by another tab, or null. */
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
  try {
    localStorage.setItem(key, JSON.stringify(value));
    held.delete(key);
  } catch {
    held.set(key, value);
  }
}
