/** Read an evaluation: its headline figures and its recorded paths. */

import { request } from "./api.js";
import { readNpz } from "./npz.js";

/** Return the figures that a comparison shows, from the summary of an evaluation; null without one. */
export function figuresOf(summary) {
  if (!summary) return null;
  return { speed: summary.speed_mps?.mean, top: summary.paper?.top_speed_mps, distance: summary.distance_m?.mean, falls: summary.falls?.rate };
}

/** Return mean speed and interval by start line, `key` being "paper" or "all"; lines without a figure are left out. */
export function profile(summary, key) {
  return summary.speed_by_line.filter((e) => e[key].mean !== null).map((e) => ({ line: e.line_m, mean: e[key].mean, low: e[key].ci?.[0] ?? e[key].mean, high: e[key].ci?.[1] ?? e[key].mean }));
}

/** Mean of several profiles, its band one standard deviation between them, at lines that at least half of them have; one alone stays as it is. */
export function meanProfile(profiles) {
  if (profiles.length === 1) return profiles[0];
  const lines = [...new Set(profiles.flatMap((rows) => rows.map((r) => r.line)))].sort((a, b) => a - b);
  return lines.flatMap((line) => {
    const means = profiles.flatMap((rows) => rows.filter((r) => r.line === line).map((r) => r.mean));
    if (means.length * 2 < profiles.length) return [];
    const mean = means.reduce((a, b) => a + b, 0) / means.length;
    const sd = means.length > 1 ? Math.sqrt(means.reduce((a, b) => a + (b - mean) ** 2, 0) / (means.length - 1)) : 0;
    return [{ line, mean, low: mean - sd, high: mean + sd }];
  });
}

/** Force in newtons from which a foot counts as on the ground; the league's run challenge uses the same. */
export const CONTACT_N = 0.01;

/** The recorded paths of an evaluation's first episodes. */
export class Paths {
  constructor(arrays, finish) {
    const need = (name) => {
      const array = arrays.get(name);
      if (!array) throw new Error(`trajectories.npz has no array “${name}”`);
      return array;
    };
    const x = need("x");
    [this.count, this.length] = x.shape;
    this.cycle = arrays.get("cycle_s")?.data[0] ?? 0.02;
    this.names = { x, y: need("y"), height: need("height"), left: need("left_foot_force"), right: need("right_foot_force") };
    this.finish = finish;
    this.cache = new Map();
  }

  /** Fetch and read them. `finish` is the finish line's x in metres or null. */
  static async load(file, finish, signal) {
    const response = await request(file.url, { signal, headers: { Accept: "*/*" } });
    return new Paths(await readNpz(await response.arrayBuffer()), finish);
  }

  /** One episode: samples without padding, and how it ended. */
  episode(i) {
    if (this.cache.has(i)) return this.cache.get(i);
    const of = (array) => array.data.subarray(i * this.length, (i + 1) * this.length);
    const rows = Object.fromEntries(Object.entries(this.names).map(([k, v]) => [k, of(v)]));
    let n = rows.x.length;
    while (n > 0 && Number.isNaN(rows.x[n - 1])) n -= 1;
    for (const key of Object.keys(rows)) rows[key] = rows[key].subarray(0, n);
    // A foot that lands on its edge is pushed sideways or down for a moment; it has contact all the same.
    for (const key of ["left", "right"]) rows[key] = rows[key].map(Math.abs);
    const dx = rows.x[n - 1] - rows.x[0], dy = rows.y[n - 1] - rows.y[0];
    const episode = {
      ...rows, samples: n, seconds: (n - 1) * this.cycle, distance: dx, speed: n > 1 ? dx / ((n - 1) * this.cycle) : 0,
      deviation: (Math.atan2(Math.abs(dy), Math.abs(dx)) * 180) / Math.PI, arrived: this.finish !== null && rows.x[n - 1] >= this.finish,
    };
    this.cache.set(i, episode);
    return episode;
  }

  all() { return Array.from({ length: this.count }, (_, i) => this.episode(i)); }
}

/**
 * Describe the gait between two samples: touchdowns per second, share of time on the ground per foot, share in flight, stride length.
 *
 * @returns {{stepRate: number|null, duty: [number, number], flight: number, stride: number|null, touchdowns: [number, number]}}
 */
export function gait(episode, cycle, from = 0, to = episode.samples) {
  let flight = 0;
  const ground = [0, 0], touchdowns = [0, 0];
  for (let t = from; t < to; t++) {
    const on = [episode.left[t] >= CONTACT_N, episode.right[t] >= CONTACT_N];
    if (!on[0] && !on[1]) flight += 1;
    for (const foot of [0, 1]) {
      if (!on[foot]) continue;
      ground[foot] += 1;
      const before = foot ? episode.right[t - 1] : episode.left[t - 1];
      if (t > from && before < CONTACT_N) touchdowns[foot] += 1;
    }
  }
  const n = Math.max(1, to - from), seconds = n * cycle, steps = touchdowns[0] + touchdowns[1];
  const moved = episode.x[Math.max(from, to - 1)] - episode.x[from];
  return { stepRate: steps ? steps / seconds : null, duty: [ground[0] / n, ground[1] / n], flight: flight / n, stride: steps ? (2 * moved) / steps : null, touchdowns };
}
