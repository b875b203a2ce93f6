/** The log of a game in the browser; `naosprint.matches.log.GameLog` describes and writes it. */

import { readNpz } from "./npz.js";

const FORMAT = 1;
const MM = 1e-3;
const RAD = 2e-4;
const LYING_M = 0.35;
const ARRAYS = ["half", "clock_s", "score", "ball", "torso", "quaternion", "joints", "present"];
export const FRAME_S = 0.04;

export class GameLog {
  /** Read a file. @param {ArrayBuffer} buffer */
  static async read(buffer) {
    const arrays = await readNpz(buffer);
    const meta = JSON.parse(new TextDecoder().decode(arrays.get("meta").data));
    if (meta.format !== FORMAT) throw new Error(`the log has format ${meta.format}, this page reads ${FORMAT}`);
    return new GameLog(meta, Object.fromEntries(ARRAYS.map((name) => [name, arrays.get(name).data])));
  }

  /** @param {object} meta teams, robots and notes @param {object} arrays by name, in the units of the file */
  constructor(meta, arrays) {
    this.meta = meta;
    this.teams = meta.teams;
    this.robots = meta.robots;
    this.frames = arrays.clock_s.length;
    Object.assign(this, arrays);
    /** Number of joints of a robot; 0 if its joints are not in the log. */
    this.width = this.joints.length / (this.frames * this.robots.length);
  }

  /** This log and the frames of a later one of the same robots from `first` on; at most `most` frames, the last ones. */
  joined(later, first, most) {
    const drop = Math.max(0, this.frames + later.frames - first - most);
    const joined = ARRAYS.map((name) => {
      const [mine, others] = [this[name], later[name]];
      const [before, after] = [drop * (mine.length / this.frames), first * (others.length / later.frames)];
      const all = new mine.constructor(mine.length - before + others.length - after);
      all.set(mine.subarray(before));
      all.set(others.subarray(after), mine.length - before);
      return [name, all];
    });
    return new GameLog(later.meta, Object.fromEntries(joined));
  }

  /** Frames in which a team has scored, and which. */
  get goals() {
    const found = [];
    for (let i = 1; i < this.frames; i++)
      for (const team of [0, 1]) if (this.score[2 * i + team] > this.score[2 * i - 2 + team]) found.push([i, team]);
    return found;
  }

  /** Where the ball is between two frames, metres; in the later one if the game was stopped between them. */
  ballAt(frame, out = [0, 0, 0]) {
    const [a, b, mix] = this.between(frame);
    for (let k = 0; k < 3; k++) out[k] = MM * (this.ball[3 * a + k] * (1 - mix) + this.ball[3 * b + k] * mix);
    return out;
  }

  /** The frames around a fraction of one, and the share of the later. */
  between(frame) {
    const a = Math.max(0, Math.min(this.frames - 1, Math.floor(frame)));
    const b = Math.min(this.frames - 1, a + 1);
    return this.half[a] === this.half[b] ? [a, b, frame - a] : [a, a, 0];
  }

  /** Position of a robot's torso in a frame, metres. */
  torsoAt(i, robot, out = [0, 0, 0]) {
    const k = 3 * (i * this.robots.length + robot);
    for (let j = 0; j < 3; j++) out[j] = MM * this.torso[k + j];
    return out;
  }

  /** Orientation of a robot's torso in a frame: x, y, z, w; not normalized. */
  turnAt(i, robot) {
    const k = 4 * (i * this.robots.length + robot);
    const q = this.quaternion;
    return [q[k + 1], q[k + 2], q[k + 3], q[k]];
  }

  /** Angles of a robot's joints between two frames, radians. */
  anglesAt(a, b, mix, robot, out) {
    const [from, to] = [a, b].map((i) => (i * this.robots.length + robot) * this.width);
    for (let j = 0; j < this.width; j++) out[j] = RAD * (this.joints[from + j] * (1 - mix) + this.joints[to + j] * mix);
    return out;
  }

  /** Whether a robot is on the field in a frame. */
  isHere(i, robot) {
    return this.present[i * this.robots.length + robot] !== 0;
  }

  /** Direction of a robot in a frame, radians. */
  headingAt(i, robot) {
    const [x, y, z, w] = this.turnAt(i, robot);
    return Math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z);
  }

  /** What a frame shows, as `Pitch.show` takes it, with half, clock and score. */
  at(i) {
    const players = [];
    this.robots.forEach(([team, number], robot) => {
      if (!this.isHere(i, robot)) return;
      const [x, y, z] = this.torsoAt(i, robot);
      players.push([team, number, x, y, this.headingAt(i, robot), z < LYING_M]);
    });
    return {
      half: this.half[i],
      clock_s: this.clock_s[i],
      goals: [this.score[2 * i], this.score[2 * i + 1]],
      ball: this.ballAt(i).slice(0, 2),
      players,
    };
  }
}
