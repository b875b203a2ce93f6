/** Watch the recorded episodes of a job, and record its newest checkpoint. */

import { fill, h, icon } from "../dom.js";
import { FILM, requestEvaluation } from "../evaluation.js";
import { integer, stamp } from "../format.js";
import { Player } from "./player.js";

export class ReplayTab {
  constructor(root, store, { sub, go }) {
    this.root = root;
    this.store = store;
    this.go = go;
    this.wanted = sub ?? null;
    for (const topic of ["evaluations", "checkpoints"]) store.on(topic, () => this.draw());
    this.draw();
  }

  update({ sub }) {
    this.wanted = sub ?? null;
    this.draw();
    return true;
  }

  draw() {
    if (this.gone) return;
    const { evaluations, checkpoints } = this.store;
    const file = (e) => e.files.find((f) => f.name === "replay.json");
    const watchable = (evaluations ?? []).filter((e) => e.state === "succeeded" && file(e));
    const open = (evaluations ?? []).some((e) => ["queued", "starting", "running"].includes(e.state));
    const chosen = watchable.find((e) => e.id === this.wanted) ?? watchable[0];
    const key = JSON.stringify([watchable.map((e) => e.id), chosen?.id, open, Boolean(checkpoints?.length)]);
    if (key === this.key) return;
    this.key = key;
    const record = h(
      "button",
      { disabled: !checkpoints?.length || open, "data-action": "record", onclick: () => this.record(record) },
      icon("play"),
      open ? "Recording…" : "Record the newest checkpoint",
    );
    if (!chosen) {
      this.stop();
      fill(
        this.root,
        h(
          "div",
          { class: "card empty" },
          h("h2", null, open ? "Recording" : "Nothing to watch yet"),
          h(
            "p",
            null,
            open
              ? "A worker runs the policy; the replay opens here when it is done."
              : checkpoints?.length
                ? "Run the newest checkpoint for a few episodes and watch one of them, even while the training continues."
                : "There is no checkpoint to watch yet.",
          ),
          h("div", { class: "row" }, record),
        ),
      );
      return;
    }
    const steps = new Map((checkpoints ?? []).map((c) => [c.id, c.step]));
    const choice = h(
      "select",
      {
        "aria-label": "Which recording",
        style: { width: "auto" },
        onchange: () => this.go(`/jobs/${this.store.id}/replay/${choice.value}`),
      },
      watchable.map((e) =>
        h(
          "option",
          { value: e.id },
          `${steps.has(e.checkpoint_id) ? `Step ${integer(steps.get(e.checkpoint_id))}` : "Deleted checkpoint"}, ${stamp(e.created_at).slice(5, 16)}`,
        ),
      ),
    );
    choice.value = chosen.id;
    if (this.shown !== chosen.id || !this.box?.isConnected) {
      this.stop();
      this.shown = chosen.id;
      this.box = h("section", { class: "card" });
      this.player = new Player(this.box, {
        path: file(chosen).url,
        task: chosen.summary?.task?.name,
        signal: this.store.signal,
      });
    }
    fill(
      this.root,
      h(
        "div",
        { class: "row wrap", style: { "margin-bottom": "1rem" } },
        choice,
        h("span", { style: { flex: 1 } }),
        record,
      ),
      this.box,
    );
  }

  /** Request a few episodes of the newest checkpoint, one of which is recorded. */
  async record(button) {
    const done = "A worker will run the newest checkpoint.";
    const made = await requestEvaluation(this.store, button, { spec: FILM.spec }, done);
    this.wanted = made?.id ?? this.wanted;
  }

  stop() {
    this.player?.destroy();
    this.player = null;
    this.shown = null;
  }

  destroy() {
    this.gone = true;
    this.stop();
  }
}
