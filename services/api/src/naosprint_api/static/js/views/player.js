/** Play a recorded episode: the field in 3D, play, scrub, slow motion, cameras, foot forces. */

import { request } from "../api.js";
import { descriptions } from "../descriptions.js";
import { fill, h, icon, setText } from "../dom.js";
import { fixed } from "../format.js";
import { loading, notice } from "./messages.js";

const PACES = [
  [1, "1×"],
  [0.5, "0.5×"],
  [0.25, "0.25×"],
  [0.1, "0.1×"],
];
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
      this.frame = 0;
      this.show();
      if (!matchMedia("(prefers-reduced-motion: reduce)").matches) this.play(true);
    } catch (error) {
      if (error.name !== "AbortError" && !this.gone)
        fill(box, h("div", { class: "pad" }, notice("error", "The replay could not be loaded.", error.message)));
    }
  }

  #controls() {
    const { box, recording: r } = this;
    this.pace = 1;
    this.view = h("div", {
      class: "stage",
      tabindex: 0,
      role: "application",
      "aria-label": "Replay: space plays and pauses, arrow keys step through the frames, drag turns the camera",
      onkeydown: (e) => this.onKey(e),
    });
    this.button = h("button", {
      class: "primary square",
      "data-action": "play",
      onclick: () => this.play(!this.playing),
    });
    this.range = h("input", {
      type: "range",
      min: 0,
      max: r.frames - 1,
      step: 1,
      value: 0,
      "aria-label": "Time",
      oninput: () => {
        this.play(false);
        this.frame = Number(this.range.value);
        this.show();
      },
    });
    this.time = h("span", { class: "num nowrap replay-time" });
    const group = (label, options, first, onPick) => {
      const buttons = options.map(([value, text]) =>
        h(
          "button",
          {
            "data-value": value,
            "aria-pressed": String(value === first),
            onclick: () => {
              onPick(value);
              buttons.forEach((b, i) => b.setAttribute("aria-pressed", String(options[i][0] === value)));
            },
          },
          text,
        ),
      );
      return h("div", { class: "segments", role: "group", "aria-label": label }, buttons);
    };
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
      h("div", { class: "replay-bar" }, this.button, this.range, this.time),
      h(
        "div",
        { class: "replay-bar wrap" },
        group("Speed of the replay", PACES, 1, (v) => {
          this.pace = v;
        }),
        group("Camera", VIEWS, "follow", (v) => this.stage.aim(v)),
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

  play(on) {
    const r = this.recording;
    this.playing = on;
    fill(this.button, icon(on ? "pause" : "play"));
    this.button.setAttribute("aria-label", on ? "Pause" : "Play");
    cancelAnimationFrame(this.ticking);
    if (!on) return;
    if (this.frame >= r.frames - 1) this.frame = 0;
    let before = null; // the frame clock's own times alone: it may lag behind performance.now()
    const tick = (now) => {
      if (!this.playing || this.gone) return;
      this.frame = Math.min(
        r.frames - 1,
        this.frame + (Math.min(0.25, (now - (before ?? now)) / 1000) * this.pace) / r.dt,
      );
      before = now;
      this.show();
      if (this.frame >= r.frames - 1) this.play(false);
      else this.ticking = requestAnimationFrame(tick);
    };
    this.ticking = requestAnimationFrame(tick);
  }

  show() {
    const r = this.recording;
    const at = Math.min(r.frames - 1, Math.round(this.frame));
    const [x, y, z] = r.torso(at);
    const [x0, y0] = r.torso(0);
    this.stage.show(this.frame);
    this.range.value = String(at);
    this.range.setAttribute("aria-valuetext", `${fixed(at * r.dt)} seconds`);
    setText(this.time, `${fixed(this.frame * r.dt)} / ${fixed(r.seconds)} s`);
    setText(this.cells.speed, `${fixed(r.speed(at))} m/s`);
    setText(this.cells.distance, `${fixed(Math.hypot(x - x0, y - y0))} m`);
    setText(this.cells.height, `${fixed(z, 3)} m`);
    setText(this.cells.left, `${fixed(r.forces[at][0], 0)} N`);
    setText(this.cells.right, `${fixed(r.forces[at][1], 0)} N`);
  }

  onKey(event) {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (event.key === " ") this.play(!this.playing);
    else if (event.key === "Home") {
      this.play(false);
      this.frame = 0;
      this.show();
    } else if (step) {
      this.play(false);
      this.frame = Math.max(
        0,
        Math.min(this.recording.frames - 1, Math.round(this.frame) + step * (event.shiftKey ? 10 : 1)),
      );
      this.show();
    } else return;
    event.preventDefault();
  }

  destroy() {
    this.gone = true;
    this.playing = false;
    cancelAnimationFrame(this.ticking);
    this.stage?.destroy();
  }
}
