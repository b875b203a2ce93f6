/** Build DOM without a framework: `h` for HTML, `s` for SVG. Text is always set as text, never parsed. */

const SVG = "http://www.w3.org/2000/svg";

function assign(node, props, svg) {
  for (const [key, value] of Object.entries(props ?? {})) {
    if (value === null || value === undefined || value === false) continue;
    if (key.startsWith("on") && typeof value === "function") node.addEventListener(key.slice(2).toLowerCase(), value);
    else if (key === "class")
      node.setAttribute("class", Array.isArray(value) ? value.filter(Boolean).join(" ") : value);
    else if (key === "style") for (const [name, v] of Object.entries(value)) node.style.setProperty(name, v);
    else if (key === "dataset") Object.assign(node.dataset, value);
    else if (
      !svg &&
      (key === "value" || key === "checked" || key === "disabled" || key === "htmlFor" || key === "indeterminate")
    )
      node[key] = value;
    else node.setAttribute(key, value === true ? "" : String(value));
  }
}

function append(node, kids) {
  for (const kid of kids.flat(Infinity)) {
    if (kid === null || kid === undefined || kid === false) continue;
    node.append(kid instanceof Node ? kid : document.createTextNode(String(kid)));
  }
  return node;
}

/** Create an HTML element. Properties starting with `on` are listeners; null and false ones are left out. */
export function h(tag, props, ...kids) {
  const node = document.createElement(tag);
  assign(node, props, false);
  return append(node, kids);
}

/** Create an SVG element. */
export function s(tag, props, ...kids) {
  const node = document.createElementNS(SVG, tag);
  assign(node, props, true);
  return append(node, kids);
}

/** Key that identifies a control when its part of the page is rebuilt. */
const identity = (el) =>
  [
    el.tagName,
    el.id,
    el.getAttribute("name"),
    el.getAttribute("href"),
    el.dataset.action,
    el.getAttribute("aria-label"),
    el.getAttribute("aria-label") ? null : el.textContent,
  ].join("|");

/** Boxes of `node` that scroll sideways, by their labels. */
const scrollers = (node) => [...node.querySelectorAll(".scroll-x")].map((box) => [box.getAttribute("aria-label"), box]);

/**
 * Replace the children of `node`; the focus moves to the control that replaces the focused one, and boxes that scroll
 * sideways stay where they were.
 */
export function fill(node, ...kids) {
  const places = new Map(scrollers(node).map(([label, box]) => [label, box.scrollLeft]));
  const held = document.activeElement;
  const key = held && held !== node && held !== document.body && node.contains(held) ? identity(held) : null;
  node.replaceChildren();
  append(node, kids);
  if ([...places.values()].some(Boolean))
    for (const [label, box] of scrollers(node)) box.scrollLeft = places.get(label) ?? 0;
  if (key === null) return node;
  const same = [...node.querySelectorAll(held.tagName)].find((el) => identity(el) === key);
  if (same) same.focus({ preventScroll: true });
  else focusNear(node);
  return node;
}

/** Move the focus to the title of the page. */
export function focusTitle() {
  const title = document.querySelector("main h1");
  if (!title) return;
  title.tabIndex = -1;
  title.focus({ preventScroll: true });
}

/** Move the focus from a control that is gone to the link of its row, else to the title of the page. */
function focusNear(node) {
  const link = node?.isConnected && node.closest("tr")?.querySelector("a[href]");
  if (link) link.focus({ preventScroll: true });
  else focusTitle();
}

/** Disable a button while `work` is pending; resolves to its result. The focus, which that takes, is given back. */
export async function busy(button, work) {
  const held = document.activeElement === button;
  const { parentElement } = button;
  button.disabled = true;
  try {
    return await work();
  } finally {
    button.disabled = false;
    if (held && document.activeElement === document.body) {
      if (button.isConnected) button.focus({ preventScroll: true });
      else focusNear(parentElement);
    }
  }
}

/** Set text only when it differs, so that live updates cause no needless layout. */
export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

/** Return whether an event comes from a control that takes text. */
export function isTyping(event) {
  const t = event.target;
  return (
    t instanceof HTMLElement &&
    (t.isContentEditable || /^(INPUT|TEXTAREA|SELECT)$/.test(t.tagName)) &&
    t.type !== "checkbox"
  );
}

/** A box that scrolls sideways on its own, reachable by keyboard. */
export const scroller = (label, ...kids) =>
  h("div", { class: "scroll-x", tabindex: 0, role: "region", "aria-label": label }, kids);

/** Heading of a column; `number` aligns it as numbers are. */
export const heading = (title, number = false) => h("th", { scope: "col", class: number ? "num" : null }, title);

/** A table under one row of headings; `rows` is a list, or the body itself where rows come and go. */
export const table = (headings, rows, props = null) =>
  h("table", props, h("thead", null, h("tr", null, headings)), rows instanceof Node ? rows : h("tbody", null, rows));

const ICONS = {
  plus: "M8 3v10M3 8h10",
  close: "M4 4l8 8M12 4l-8 8",
  check: "M3 8.5l3.2 3.2L13 4.8",
  pause: "M5.5 3.5v9M10.5 3.5v9",
  play: "M5 3.2v9.6L12.6 8z",
  retry: "M12.8 6.2A5.2 5.2 0 1 0 13.2 8M13 2.8v3.6H9.4",
  download: "M8 2.5v7.6M4.8 7.2L8 10.4l3.2-3.2M3 13.2h10",
  trash: "M3 4.5h10M6.5 4.5V3h3v1.5M4.4 4.5l.6 8.6h6l.6-8.6",
  search: "M7 11.5A4.5 4.5 0 1 0 7 2.5a4.5 4.5 0 0 0 0 9zM10.3 10.3l3.4 3.4",
  sun: "M8 11a3 3 0 1 0 0-6 3 3 0 0 0 0 6zM8 1.4v1.4M8 13.2v1.4M1.4 8h1.4M13.2 8h1.4M3.3 3.3l1 1M11.7 11.7l1 1M3.3 12.7l1-1M11.7 4.3l1-1",
  moon: "M13.2 9.6A5.6 5.6 0 0 1 6.4 2.8a5.6 5.6 0 1 0 6.8 6.8z",
  auto: "M8 2.4a5.6 5.6 0 1 0 0 11.2zM8 2.4a5.6 5.6 0 0 1 0 11.2",
  out: "M6.5 2.8H3v10.4h3.5M7 8h6.4M10.8 5.2L13.6 8l-2.8 2.8",
  copy: "M5.5 5.5h7.7v7.7H5.5zM10.5 5.5V2.8H2.8v7.7h2.7",
  stop: "M4 4h8v8H4z",
  branch:
    "M4.5 5.5v5M4.5 5.5a1.5 1.5 0 1 0 0-3 1.5 1.5 0 0 0 0 3zM4.5 13.5a1.5 1.5 0 1 0 0-3 1.5 1.5 0 0 0 0 3zM11.5 6.5a1.5 1.5 0 1 0 0-3 1.5 1.5 0 0 0 0 3zM11.5 6.5c0 2.6-7 1.4-7 4",
  clock: "M8 13.6A5.6 5.6 0 1 0 8 2.4a5.6 5.6 0 0 0 0 11.2zM8 4.8V8l2.4 1.4",
  dash: "M4 8h8",
  key: "M5.2 10.8a2.8 2.8 0 1 0 0-5.6 2.8 2.8 0 0 0 0 5.6zM8 8h6v2.4M11.4 8v1.8",
};

/** Return a 16 px line icon; decorative unless `label` is given. */
export function icon(name, label) {
  return s(
    "svg",
    {
      class: "icon",
      viewBox: "0 0 16 16",
      width: 16,
      height: 16,
      "aria-hidden": label ? null : "true",
      role: label ? "img" : null,
      "aria-label": label,
    },
    s("path", {
      d: ICONS[name],
      fill: "none",
      stroke: "currentColor",
      "stroke-width": 1.5,
      "stroke-linecap": "round",
      "stroke-linejoin": "round",
    }),
  );
}

/** Show a short message in the corner; errors stay until dismissed. */
export function toast(message, kind = "info") {
  const box = h(
    "div",
    { class: ["toast", kind] },
    h("span", null, message),
    h("button", { class: "ghost small", "aria-label": "Dismiss", onclick: () => box.remove() }, icon("close")),
  );
  const toasts = document.getElementById("toasts");
  toasts.append(box);
  // shown last, it lies above an open dialog
  toasts.hidePopover();
  toasts.showPopover();
  if (kind !== "error") setTimeout(() => box.remove(), 4000);
}

/** Ask in a modal dialog; resolves true when confirmed. */
export function confirmDialog({ title, body, action, danger = false }) {
  return new Promise((resolve) => {
    const dialog = h(
      "dialog",
      { class: "modal", "aria-labelledby": "dialog-title" },
      h(
        "form",
        { method: "dialog" },
        h("h2", { id: "dialog-title" }, title),
        h("p", null, body),
        h(
          "div",
          { class: "row end" },
          h("button", { value: "no" }, "Back"),
          h("button", { value: "yes", class: danger ? "danger" : "primary" }, action),
        ),
      ),
    );
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve(dialog.returnValue === "yes");
    });
    document.body.append(dialog);
    dialog.showModal();
  });
}
