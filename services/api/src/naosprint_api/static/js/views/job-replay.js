/** Watch the recorded episodes of a job, and record its newest checkpoint. */

import { fill, h, icon } from "../dom.js";
import { FILM, requestEvaluation } from "../evaluation.js";
import { isEnded } from "../states.js";
import { RecordedTab } from "./job-recorded.js";
import { Player } from "./player.js";

export class ReplayTab extends RecordedTab {
  draw() {
    if (this.gone) return;
    const { evaluations, checkpoints } = this.store;
    const file = (e) => e.files.find((f) => f.name === "replay.json");
    const watchable = (evaluations ?? []).filter((e) => e.state === "succeeded" && file(e));
    const open = (evaluations ?? []).some((e) => !isEnded(e.state));
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
    fill(this.root, this.head("Which recording", "replay", watchable, chosen, record), this.box);
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
    super.destroy();
    this.stop();
  }
}
