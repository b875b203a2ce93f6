/** The log of a game in the browser; `naosprint.matches.log.GameLog` describes and writes it. */

import { readNpz } from "./npz.js";

const FORMAT = 1;
const MM = 1e-3;
const LYING_M = 0.35;
export const FRAME_S = 0.04;

export class GameLog {
  /** Read a file. @param {ArrayBuffer} buffer */
  static async read(buffer) {
    const arrays = await readNpz(buffer);
    const meta = JSON.parse(new TextDecoder().decode(arrays.get("meta").data));
    if (meta.format !== FORMAT) throw new Error(`the log has format ${meta.format}, this page reads ${FORMAT}`);
    return new GameLog(arrays, meta);
  }

  constructor(arrays, meta) {
    this.teams = meta.teams;
    this.robots = meta.robots;
    this.frames = arrays.get("clock_s").data.length;
    for (const name of ["half", "clock_s", "score", "ball", "torso", "quaternion", "present"])
      this[name] = arrays.get(name).data;
  }

  /** Frames in which a team has scored, and the halves' first ones. */
  get goals() {
    const found = [];
    for (let i = 1; i < this.frames; i++)
      for (const team of [0, 1]) if (this.score[2 * i + team] > this.score[2 * i - 2 + team]) found.push([i, team]);
    return found;
  }

  /** What a frame shows, as `Pitch.show` takes it, with half, clock and score. */
  at(i) {
    const n = this.robots.length;
    const players = [];
    this.robots.forEach(([team, number], robot) => {
      const k = i * n + robot;
      if (!this.present[k]) return;
      const [w, x, y, z] = this.quaternion.subarray(4 * k, 4 * k + 4);
      const [px, py, pz] = this.torso.subarray(3 * k, 3 * k + 3);
      const heading = Math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z);
      players.push([team, number, px * MM, py * MM, heading, pz * MM < LYING_M]);
    });
    return {
      half: this.half[i],
      clock_s: this.clock_s[i],
      goals: [this.score[2 * i], this.score[2 * i + 1]],
      ball: [this.ball[3 * i] * MM, this.ball[3 * i + 1] * MM],
      players,
    };
  }
}
