/** Watch a game of a match: a running one as it is now, or one that is over from its log. */

import { request } from "../api.js";
import { fill, h, icon, setText } from "../dom.js";
import { bytes } from "../format.js";
import { FRAME_S, GameLog } from "../game-log.js";
import { Pitch } from "../pitch.js";
import { loading, notice } from "./messages.js";
import { Playback, segments } from "./playback.js";

const MOST_FRAMES = 150; // of a running game that are kept
const LEAD_S = 1.2; // a little more than between two moments of a running game
const PACES = [
  [0.25, "0.25×"],
  [1, "1×"],
  [4, "4×"],
  [16, "16×"],
];

/** Half, clock and score in a line above the field. */
class Board {
  constructor(teams) {
    this.score = h("strong", { class: "num" });
    this.clock = h("span", { class: "num muted" });
    const name = (team) => h("span", { class: "team", "data-team": team }, teams[team]);
    this.element = h("div", { class: "replay-bar board" }, name(0), this.score, name(1), this.clock);
  }

  show({ goals, half, clock_s: clock }) {
    const seconds = Math.floor(clock);
    setText(this.score, `${goals[0]} : ${goals[1]}`);
    setText(this.clock, `Half ${half + 1}, ${Math.floor(seconds / 60)}:${String(seconds % 60).padStart(2, "0")}`);
  }
}

const CAMERAS = [
  ["ball", "Ball"],
  ["above", "Above"],
  ["field", "Field"],
];

/** The field with all robots and the ball: in three dimensions, or from above where that cannot be drawn. */
class GameView {
  /** @param {string} label for readers of the screen @param {(e: KeyboardEvent) => void} onKey */
  constructor(field, label, onKey) {
    this.field = field;
    this.label = label;
    this.element = h("div", { class: "stage game", tabindex: 0, role: "application", "aria-label": label });
    if (onKey) this.element.addEventListener("keydown", onKey);
    this.cameras = h("div", { class: "row wrap" });
  }

  /** Load what draws the robots of a log; `show` shows its frames from then on. */
  async open(log) {
    this.log = log;
    try {
      const { GameStage, figureOf } = await import("../game3d.js");
      const figure = await figureOf(log);
      if (this.gone) return;
      this.stage = new GameStage(this.element, log, figure, this.field);
      this.stage.compact = this.element.clientWidth < 600;
      this.#aims();
    } catch (error) {
      this.pitch = new Pitch(this.field, this.label);
      this.element.classList.remove("stage");
      fill(this.element, this.pitch.element);
      fill(this.cameras, h("span", { class: "muted" }, `Shown from above: ${error.message}`));
    }
  }

  #aims() {
    const robots = h(
      "select",
      {
        "aria-label": "Robot that the camera follows",
        onchange: () => {
          if (robots.value === "") return;
          for (const button of views.children) button.setAttribute("aria-pressed", "false");
          this.#aim(Number(robots.value));
        },
      },
      h("option", { value: "" }, "Robot…"),
      this.log.robots.map(([team, number], i) => h("option", { value: i }, `${this.log.teams[team]} ${number}`)),
    );
    const views = segments("Camera", CAMERAS, "ball", (view) => {
      robots.value = "";
      this.#aim(view);
    });
    fill(this.cameras, views, robots);
  }

  #aim(view) {
    this.stage.aim(view);
    this.show(this.stage.frame);
  }

  /** Use another log of the same robots, whose frames are `step` times as far apart as those of a file. */
  use(log, step) {
    this.log = log;
    if (this.stage) Object.assign(this.stage, { log, step });
  }

  /** Show a frame; it may lie between two. */
  show(frame) {
    this.stage?.show(frame);
    this.pitch?.show(this.log.at(Math.round(frame)));
  }

  destroy() {
    this.gone = true;
    this.stage?.destroy();
  }
}

/** A running game; `show` takes what the service says of it, and its last seconds are played while the next ones come. */
export class LiveGame {
  constructor(box, teams, field) {
    this.board = new Board(teams);
    this.view = new GameView(field, "The running game");
    this.calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
    fill(box, this.board.element, this.view.element, h("div", { class: "replay-bar" }, this.view.cameras));
  }

  async show(live) {
    this.board.show(live);
    if (!live.clip || live.clip === this.clip) return;
    this.clip = live.clip;
    const log = await GameLog.read(Uint8Array.from(atob(live.clip), (c) => c.charCodeAt(0)).buffer);
    if (this.gone) return;
    const { first, step } = log.meta.notes;
    const part = `${live.game} ${live.half}`;
    // frames of the clip that the one before has had already
    const known = this.part === part ? Math.min(log.frames, Math.max(0, Math.ceil((this.next - first) / step))) : 0;
    if (this.part === part && this.step === step) {
      const all = this.log.joined(log, known, MOST_FRAMES);
      this.frame = Math.max(0, this.frame - (this.log.frames + log.frames - known - all.frames));
      this.log = all;
    } else {
      this.frame = Math.min(known, log.frames - 1);
      this.log = log;
    }
    Object.assign(this, { part, step, next: first + log.frames * step });
    if (this.opening) this.view.use(this.log, step);
    else {
      this.opening = this.view.open(this.log);
      await this.opening;
      this.view.use(this.log, this.step);
      this.#tick();
    }
    // what is there is played until the next moments are about to come
    this.rate = (this.log.frames - 1 - this.frame) / LEAD_S;
    if (this.calm) this.view.show(this.log.frames - 1);
  }

  #tick(before) {
    if (this.gone || this.calm) return;
    requestAnimationFrame((now) => {
      const passed = Math.min(0.25, (now - (before ?? now)) / 1000);
      const frame = Math.min(this.log.frames - 1, this.frame + passed * this.rate);
      if (frame !== this.frame && this.view.element.isConnected) this.view.show(frame);
      this.frame = frame;
      this.#tick(now);
    });
  }

  destroy() {
    this.gone = true;
    this.view.destroy();
  }
}

/** A game that is over, with its log. */
export class GameReplay {
  constructor(box, path, field, signal) {
    fill(box, loading("Loading the log"));
    this.#load(box, path, field, signal);
  }

  async #load(box, path, field, signal) {
    try {
      const log = await GameLog.read(await (await request(path, { signal, headers: { Accept: "*/*" } })).arrayBuffer());
      if (this.gone) return;
      const board = new Board(log.teams);
      const keys = "space plays and pauses, arrow keys step through the frames, drag turns the camera";
      const view = new GameView(field, `The game: ${keys}`, (e) => playback.onKey(e));
      this.view = view;
      const playback = new Playback(
        log.frames,
        FRAME_S,
        () => {
          board.show(log.at(playback.at));
          view.show(playback.frame);
          playback.mark(`${board.clock.textContent}, ${board.score.textContent}`);
        },
        PACES,
      );
      this.playback = playback;
      const goals = log.goals.map(([frame, team]) =>
        h(
          "button",
          {
            class: "small",
            onclick: () => {
              playback.frame = Math.max(0, frame - 5 / FRAME_S);
              playback.play(true);
            },
          },
          `Goal of ${log.teams[team]}, ${log.at(frame).goals.join(" : ")}`,
        ),
      );
      fill(
        box,
        board.element,
        view.element,
        h("div", { class: "replay-bar" }, playback.button, playback.range),
        h("div", { class: "replay-bar wrap" }, playback.paces, view.cameras, goals),
      );
      await view.open(log);
      if (!this.gone) playback.start();
    } catch (error) {
      if (error.name !== "AbortError" && !this.gone)
        fill(box, h("div", { class: "pad" }, notice("error", "The log could not be loaded.", error.message)));
    }
  }

  destroy() {
    this.gone = true;
    this.playback?.destroy();
    this.view?.destroy();
  }
}

/** The film of a game, which is loaded when it is to be played. */
export class GameFilm {
  constructor(box, file, signal) {
    const load = async () => {
      button.disabled = true;
      try {
        const answer = await request(file.url, { signal, headers: { Accept: "*/*" } });
        const blob = new Blob([await answer.arrayBuffer()], { type: "video/mp4" });
        if (this.gone) return;
        this.address = URL.createObjectURL(blob);
        fill(box, h("video", { class: "film", controls: true, autoplay: true, muted: true, src: this.address }));
      } catch (error) {
        if (error.name !== "AbortError" && !this.gone)
          fill(box, h("div", { class: "pad" }, notice("error", "The film could not be loaded.", error.message)));
      }
    };
    const button = h(
      "button",
      { "data-action": "film", onclick: load },
      icon("play"),
      `Play the film, ${bytes(file.size)}`,
    );
    fill(box, h("div", { class: "replay-bar" }, button));
  }

  destroy() {
    this.gone = true;
    if (this.address) URL.revokeObjectURL(this.address);
  }
}
