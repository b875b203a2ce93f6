/** Controls of anything that plays frame by frame: a button, a slider, paces and keys. */

import { fill, h, icon } from "../dom.js";

const PACES = [
  [1, "1×"],
  [0.5, "0.5×"],
  [0.25, "0.25×"],
  [0.1, "0.1×"],
];

/** A row of buttons of which one is pressed. */
export function segments(label, options, first, onPick) {
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
}

export class Playback {
  /**
   * @param {number} frames @param {number} dt seconds between two frames
   * @param {() => void} onFrame called when `frame`, which may be a fraction, has changed
   * @param {[number, string][]} paces factors and their labels
   */
  constructor(frames, dt, onFrame, paces = PACES) {
    Object.assign(this, { frames, dt, onFrame, frame: 0, pace: 1 });
    this.button = h("button", {
      class: "primary square",
      "data-action": "play",
      onclick: () => this.play(!this.playing),
    });
    this.range = h("input", {
      type: "range",
      min: 0,
      max: frames - 1,
      step: 1,
      value: 0,
      "aria-label": "Time",
      oninput: () => this.#stop(Number(this.range.value)),
    });
    this.paces = segments("Speed of the replay", paces, 1, (pace) => {
      this.pace = pace;
    });
  }

  /** The whole frame that is shown. */
  get at() {
    return Math.min(this.frames - 1, Math.round(this.frame));
  }

  /** Show the frame on the slider; `text` says what it is. */
  mark(text) {
    this.range.value = String(this.at);
    this.range.setAttribute("aria-valuetext", text);
  }

  /** Start, unless the user prefers less motion. */
  start() {
    this.onFrame();
    this.play(!matchMedia("(prefers-reduced-motion: reduce)").matches);
  }

  play(on) {
    this.playing = on;
    fill(this.button, icon(on ? "pause" : "play"));
    this.button.setAttribute("aria-label", on ? "Pause" : "Play");
    cancelAnimationFrame(this.ticking);
    if (!on) return;
    if (this.frame >= this.frames - 1) this.frame = 0;
    let before = null; // the frame clock's own times alone: it may lag behind performance.now()
    const tick = (now) => {
      if (!this.playing) return;
      const passed = Math.min(0.25, (now - (before ?? now)) / 1000);
      this.frame = Math.min(this.frames - 1, this.frame + (passed * this.pace) / this.dt);
      before = now;
      this.onFrame();
      if (this.frame >= this.frames - 1) this.play(false);
      else this.ticking = requestAnimationFrame(tick);
    };
    this.ticking = requestAnimationFrame(tick);
  }

  #stop(frame) {
    this.play(false);
    this.frame = Math.max(0, Math.min(this.frames - 1, frame));
    this.onFrame();
  }

  onKey(event) {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (event.key === " ") this.play(!this.playing);
    else if (event.key === "Home") this.#stop(0);
    else if (step) this.#stop(Math.round(this.frame) + step * (event.shiftKey ? 10 : 1));
    else return;
    event.preventDefault();
  }

  destroy() {
    this.playing = false;
    cancelAnimationFrame(this.ticking);
  }
}
