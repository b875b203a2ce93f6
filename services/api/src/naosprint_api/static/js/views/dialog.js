/** Parts of modal dialogs with a form. */

import { call } from "../api.js";
import { busy, confirmDialog, fill, h, icon, toast } from "../dom.js";

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

/**
 * Button that requests something of the service, after a confirmation where there is a `question`; `after` is called
 * with whether the service has done it.
 */
export function action(name, label, glyph, path, { method = "POST", question, after }) {
  const press = async () => {
    if (question && !(await confirmDialog({ action: label, danger: true, ...question }))) return;
    await busy(button, async () => {
      const done = await call(path, { method }).then(
        () => true,
        (error) => toast(error.message, "error"),
      );
      await after(Boolean(done));
    });
  };
  const shade = method === "DELETE" ? "danger" : null;
  const button = h("button", { class: shade, "data-action": name, onclick: press }, icon(glyph), label);
  return button;
}

/** The parts of a text between commas. */
export const separated = (text) =>
  text
    .split(",")
    .map((part) => part.trim())
    .filter(Boolean);
