/** Dialogs about a job: its name, tags and notes, and links for others. */

import { call } from "../api.js";
import { fill, h, toast } from "../dom.js";
import { stamp } from "../format.js";

/** Show a modal dialog; it is removed when it closes. */
function open(title, ...parts) {
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

/** Dialog that edits name, tags and notes; resolves to the changed job, null if nothing was changed. */
export function editJob(job) {
  return new Promise((resolve) => {
    let changed = null;
    const name = h("input", { id: "edit-name", name: "edit-name", value: job.name, required: true, maxlength: 200 });
    const tags = h("input", { id: "edit-tags", name: "edit-tags", value: job.tags.join(", "), spellcheck: "false" });
    const notes = h("textarea", { id: "edit-notes", name: "edit-notes", rows: 6, maxlength: 10000 });
    notes.value = job.notes;
    const trouble = h("p", { class: "problem", role: "alert" });
    const field = (label, input, hint) =>
      h(
        "div",
        { class: "field" },
        h("label", { for: input.id }, label),
        input,
        hint && h("p", { class: "hint" }, hint),
      );
    const submit = async (event) => {
      event.preventDefault();
      const body = {
        name: name.value.trim(),
        tags: tags.value
          .split(",")
          .map((tag) => tag.trim())
          .filter(Boolean),
        notes: notes.value,
      };
      try {
        changed = await call(`jobs/${encodeURIComponent(job.id)}`, { method: "PATCH", body });
        dialog.close();
      } catch (error) {
        fill(trouble, [...(error.fields ?? [])].map(([key, text]) => `${key}: ${text}`).join("; ") || error.message);
      }
    };
    const dialog = open(
      "Edit job",
      h(
        "form",
        { class: "stack", onsubmit: submit },
        field("Name", name),
        field("Tags", tags, "Separated by commas."),
        field("Notes", notes),
        trouble,
        h(
          "div",
          { class: "row end" },
          h("button", { type: "button", onclick: () => dialog.close() }, "Back"),
          h("button", { class: "primary", type: "submit" }, "Save"),
        ),
      ),
    );
    dialog.addEventListener("close", () => resolve(changed));
  });
}

/** Make a link with a read-only token, or revoke all links to the job. */
export function shareJob(job) {
  const days = h(
    "select",
    { id: "share-days" },
    [1, 7, 30, 90].map((n) => h("option", { value: n }, n === 1 ? "1 day" : `${n} days`)),
  );
  days.value = "30";
  const made = h("div");
  const path = `jobs/${encodeURIComponent(job.id)}/share`;
  const fail = (error) => fill(made, h("p", { class: "problem", role: "alert" }, error.message));
  const make = async () => {
    try {
      const link = await call(path, { method: "POST", body: { expires_in_days: Number(days.value) } });
      const address = new URL(`#/jobs/${job.id}?token=${link.token}`, location.href.split("#")[0]).href;
      const shown = h("input", { readonly: true, value: address, "aria-label": "Link", onfocus: () => shown.select() });
      fill(made, shown, h("p", { class: "hint" }, `Valid until ${stamp(link.expires_at)}. It is shown only here.`));
      shown.focus();
      navigator.clipboard?.writeText(address).then(
        () => toast("The link was copied."),
        () => {},
      );
    } catch (error) {
      fail(error);
    }
  };
  const revoke = async () => {
    try {
      await call(path, { method: "DELETE" });
      fill(made, h("p", null, "All links to this job are revoked."));
    } catch (error) {
      fail(error);
    }
  };
  const dialog = open(
    "Share job",
    h(
      "p",
      null,
      `Anyone with the link can see ${job.name}: curves, log, checkpoints and evaluations. The link is read-only.`,
    ),
    h(
      "div",
      { class: "stack" },
      h("div", { class: "field" }, h("label", { for: "share-days" }, "Valid for"), days),
      made,
      h(
        "div",
        { class: "row end wrap" },
        h("button", { class: "danger", onclick: revoke }, "Revoke all links"),
        h("button", { onclick: () => dialog.close() }, "Close"),
        h("button", { class: "primary", "data-action": "make-link", onclick: make }, "Create link"),
      ),
    ),
  );
}
