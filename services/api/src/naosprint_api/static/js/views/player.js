/** Play a recorded episode: the field in 3D, play, scrub, slow motion, cameras, foot forces. */

import { request } from "../api.js";
import { descriptions } from "../descriptions.js";
import { fill, h, setText } from "../dom.js";
import { fixed } from "../format.js";
import { loading, notice } from "./messages.js";
import { Playback, segments } from "./playback.js";

const VIEWS = [
  ["follow", "Follow"],
  ["side", "Side"],
  ["front", "Front"],
  ["field", "Field"],
  ["free", "Free"],
];

export class Player {
  /**
   * Fetch a recording and play it in `box`; errors are shown there.
   *
   * @param {HTMLElement} box
   * @param {{path: string, task: string, signal?: AbortSignal}} source the replay's path in the API, and the task whose
   *   lines are drawn
   */
  constructor(box, { path, task, signal }) {
    this.box = box;
    fill(box, loading("Loading the replay"));
    this.#load(path, task, signal);
  }

  async #load(path, task, signal) {
    const { box } = this;
    try {
      const [{ Recording, Stage }, response, known] = await Promise.all([
        import("../replay3d.js"),
        request(path, { signal }),
        descriptions(),
      ]);
      const text = await response.json();
      const recording = new Recording(text, known.robot(text.robot)?.front_axis);
      if (this.gone) return;
      this.recording = recording;
      this.#controls();
      try {
        this.stage = new Stage(this.view, recording, known.field(text.robot), known.task(task)?.lines ?? []);
      } catch (error) {
        fill(
          box,
          h(
            "div",
            { class: "pad" },
            notice(
              "error",
              "This browser does not support WebGL.",
              `Turn hardware acceleration on, or use another browser. (${error.message})`,
            ),
          ),
        );
        return;
      }
      this.playback.start();
    } catch (error) {
      if (error.name !== "AbortError" && !this.gone)
        fill(box, h("div", { class: "pad" }, notice("error", "The replay could not be loaded.", error.message)));
    }
  }

  #controls() {
    const { box, recording: r } = this;
    this.playback = new Playback(r.frames, r.dt, () => this.show());
    this.view = h("div", {
      class: "stage",
      tabindex: 0,
      role: "application",
      "aria-label": "Replay: space plays and pauses, arrow keys step through the frames, drag turns the camera",
      onkeydown: (e) => this.playback.onKey(e),
    });
    this.time = h("span", { class: "num nowrap replay-time" });
    const forces = h("input", {
      type: "checkbox",
      checked: true,
      onchange: () => {
        this.stage.showForces = forces.checked;
        this.show();
      },
    });
    this.cells = Object.fromEntries(
      ["speed", "distance", "height", "left", "right"].map((key) => [key, h("div", { class: "v" })]),
    );
    const stat = (key, label) => h("div", null, h("div", { class: "k" }, label), this.cells[key]);
    fill(
      box,
      this.view,
      h("div", { class: "replay-bar" }, this.playback.button, this.playback.range, this.time),
      h(
        "div",
        { class: "replay-bar wrap" },
        this.playback.paces,
        segments("Camera", VIEWS, "follow", (v) => this.stage.aim(v)),
        h("label", { class: "row nowrap" }, forces, "Foot forces"),
        h("span", { class: "muted" }, `${r.failed ? "Failed" : "Ended"}: ${r.end || "time limit"}.`),
      ),
      h(
        "div",
        { class: "stats flat" },
        stat("speed", "Speed"),
        stat("distance", "Distance"),
        stat("height", "Torso height"),
        stat("left", "Left foot"),
        stat("right", "Right foot"),
      ),
    );
  }

  show() {
    const r = this.recording;
    const { at, frame } = this.playback;
    const [x, y, z] = r.torso(at);
    const [x0, y0] = r.torso(0);
    this.stage.show(frame);
    this.playback.mark(`${fixed(at * r.dt)} seconds`);
    setText(this.time, `${fixed(frame * r.dt)} / ${fixed(r.seconds)} s`);
    setText(this.cells.speed, `${fixed(r.speed(at))} m/s`);
    setText(this.cells.distance, `${fixed(Math.hypot(x - x0, y - y0))} m`);
    setText(this.cells.height, `${fixed(z, 3)} m`);
    setText(this.cells.left, `${fixed(r.forces[at][0], 0)} N`);
    setText(this.cells.right, `${fixed(r.forces[at][1], 0)} N`);
  }

  destroy() {
    this.gone = true;
    this.playback?.destroy();
    this.stage?.destroy();
  }
}
