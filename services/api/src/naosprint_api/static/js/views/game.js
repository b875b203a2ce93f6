/** Watch a game of a match: a running one as it is now, or one that is over from its log. */

import { request } from "../api.js";
import { fill, h, icon, setText } from "../dom.js";
import { bytes } from "../format.js";
import { FRAME_S, GameLog } from "../game-log.js";
import { Pitch } from "../pitch.js";
import { loading, notice } from "./messages.js";
import { Playback } from "./playback.js";

const PACES = [
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

/** A running game; `show` takes what the service says of it. */
export class LiveGame {
  constructor(box, teams, field) {
    this.board = new Board(teams);
    this.pitch = new Pitch(field, "The running game from above");
    fill(box, this.board.element, this.pitch.element);
  }

  show(live) {
    this.board.show(live);
    this.pitch.show(live);
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
      const pitch = new Pitch(field, "The game from above");
      const playback = new Playback(
        log.frames,
        FRAME_S,
        () => {
          const moment = log.at(playback.at);
          board.show(moment);
          pitch.show(moment);
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
        h("div", { tabindex: 0, onkeydown: (e) => playback.onKey(e) }, pitch.element),
        h("div", { class: "replay-bar" }, playback.button, playback.range),
        h("div", { class: "replay-bar wrap" }, playback.paces, goals),
      );
      playback.start();
    } catch (error) {
      if (error.name !== "AbortError" && !this.gone)
        fill(box, h("div", { class: "pad" }, notice("error", "The log could not be loaded.", error.message)));
    }
  }

  destroy() {
    this.gone = true;
    this.playback?.destroy();
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
