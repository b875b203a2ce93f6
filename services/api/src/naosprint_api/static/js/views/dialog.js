/** Parts of modal dialogs with a form. */

import { fill, h } from "../dom.js";

/** Show a modal dialog; it is removed when it closes. */
export function open(title, ...parts) {
  const dialog = h(
    "dialog",
    { class: "modal", "aria-labelledby": "dialog-title" },
    h("h2", { id: "dialog-title" }, title),
    parts,
  );
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
  return dialog;
}

/** A labelled control of a form with a hint. */
export const field = (label, input, hint) =>
  h("div", { class: "field" }, h("label", { for: input.id }, label), input, hint && h("p", { class: "hint" }, hint));

/** Show what is wrong with a form. */
export const complain = (box, error) =>
  fill(box, [...(error.fields ?? [])].map(([key, text]) => `${key}: ${text}`).join("; ") || error.message);

/** The parts of a text between commas. */
export const separated = (text) =>
  text
    .split(",")
    .map((part) => part.trim())
    .filter(Boolean);
