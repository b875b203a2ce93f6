/** Dialogs about a job: its name, tags and notes, links for others, and policies made of its checkpoints. */

import { call, submission } from "../api.js";
import { fill, h, toast } from "../dom.js";
import { integer, stamp } from "../format.js";
import { isEnded } from "../states.js";
import { complain, field, open, separated } from "./dialog.js";

/** Ask for a name and register a checkpoint as the next version of a policy. */
export function registerCheckpoint(job, checkpoint) {
  const name = h("input", {
    id: "policy-name",
    name: "policy-name",
    required: true,
    maxlength: 60,
    pattern: "[a-z0-9\\-]+",
    spellcheck: "false",
  });
  const aliases = h("input", { id: "policy-aliases", name: "policy-aliases", spellcheck: "false" });
  const notes = h("textarea", { id: "policy-notes", name: "policy-notes", rows: 3, maxlength: 10000 });
  const trouble = h("p", { class: "problem", role: "alert" });
  const send = submission();
  const submit = async (event) => {
    event.preventDefault();
    const path = `policies/${encodeURIComponent(name.value.trim())}/versions`;
    const body = {
      job_id: job.id,
      checkpoint_id: checkpoint.id,
      aliases: separated(aliases.value),
      notes: notes.value,
    };
    try {
      const card = await send(path, body);
      dialog.close();
      toast(`Step ${integer(checkpoint.step)} is policy ${card.reference}.`);
    } catch (error) {
      complain(trouble, error);
    }
  };
  const dialog = open(
    "Register policy",
    h(
      "form",
      { class: "stack", onsubmit: submit },
      field("Name", name, "Lower-case letters, digits and hyphens. An existing name gets a new version."),
      field("Aliases", aliases, "Such as best or match, separated by commas."),
      field("Notes", notes),
      trouble,
      h(
        "div",
        { class: "row end" },
        h("button", { type: "button", onclick: () => dialog.close() }, "Back"),
        h("button", { class: "primary", type: "submit" }, "Register"),
      ),
    ),
  );
}

/** Ask for an alias of a version; resolves to it, or to null if none was chosen. */
export function chooseAlias(reference) {
  return new Promise((resolve) => {
    let chosen = null;
    const alias = h("input", {
      id: "alias",
      name: "alias",
      value: "best",
      required: true,
      pattern: "[a-z][a-z0-9\\-]*",
    });
    const submit = (event) => {
      event.preventDefault();
      chosen = alias.value;
      dialog.close();
    };
    const dialog = open(
      `Promote ${reference}`,
      h(
        "form",
        { class: "stack", onsubmit: submit },
        field("Alias", alias, "It leaves the version that it names now."),
        h(
          "div",
          { class: "row end" },
          h("button", { type: "button", onclick: () => dialog.close() }, "Back"),
          h("button", { class: "primary", type: "submit" }, "Promote"),
        ),
      ),
    );
    dialog.addEventListener("close", () => resolve(chosen));
  });
}

/** Edit name, tags, notes and, until it has ended, priority; resolves to the changed job, or to null. */
export function editJob(job) {
  return new Promise((resolve) => {
    let changed = null;
    const name = h("input", { id: "edit-name", name: "edit-name", value: job.name, required: true, maxlength: 200 });
    const tags = h("input", { id: "edit-tags", name: "edit-tags", value: job.tags.join(", "), spellcheck: "false" });
    const notes = h("textarea", { id: "edit-notes", name: "edit-notes", rows: 6, maxlength: 10000 });
    notes.value = job.notes;
    const priority = h("input", {
      id: "edit-priority",
      name: "edit-priority",
      type: "number",
      min: 0,
      max: 9,
      required: true,
      value: job.priority,
    });
    const trouble = h("p", { class: "problem", role: "alert" });
    const submit = async (event) => {
      event.preventDefault();
      const wanted = {
        name: name.value.trim(),
        tags: separated(tags.value),
        notes: notes.value,
        priority: Number(priority.value),
      };
      // what was not changed here may have changed elsewhere
      const own = Object.entries(wanted).filter(([key, value]) => String(value) !== String(job[key]));
      const body = Object.fromEntries(own);
      try {
        if (own.length) changed = await call(`jobs/${encodeURIComponent(job.id)}`, { method: "PATCH", body });
        dialog.close();
      } catch (error) {
        complain(trouble, error);
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
        !isEnded(job.state) && field("Priority", priority, "0 to 9; jobs with a higher priority start first."),
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
