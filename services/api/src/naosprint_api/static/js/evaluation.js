/** Read an evaluation: its results and its recorded paths. */

import { request, submission } from "./api.js";
import { busy, toast } from "./dom.js";
import { readNpz } from "./npz.js";

const send = submission();

/** Request of a few episodes of which one is recorded, and of its film. */
export const FILM = { spec: { episodes: 5, trajectories: 5, bootstrap_resamples: 100 }, report: "film" };

/**
 * Ask for an evaluation of a job's checkpoint; the button is disabled meanwhile. Resolves to it, or to null if it was
 * refused.
 */
export async function requestEvaluation(store, button, body, done) {
  try {
    const made = await busy(button, () => send(`${store.path}/evaluations`, body));
    toast(done);
    store.read("evaluations").catch(() => {}); // it is made, whatever this answer is
    return made;
  } catch (error) {
    toast(error.message, "error");
    return null;
  }
}

/** Whether this is a document that describes its results; those of version 0.1 do not. */
export const hasResults = (summary) => Array.isArray(summary?.results);

/**
 * Evaluation that is shown for a job: of the finished ones with the most episodes, the newest. The service's `result`
 * of a job and the command line choose the same.
 *
 * @param {object[]} evaluations answer of `GET /jobs/{id}/evaluations`
 */
export function representative(evaluations) {
  const episodes = (e) => e.summary?.episodes ?? 0;
  return (
    evaluations
      .filter((e) => e.state === "succeeded")
      .sort((a, b) => episodes(b) - episodes(a) || b.finished_at.localeCompare(a.finished_at))[0] ?? null
  );
}

/** Results that the task shows first; all of them if it names none. */
export function headline(summary) {
  if (!hasResults(summary)) return [];
  const byName = new Map(summary.results.map((r) => [r.name, r]));
  const chosen = (summary.headline ?? []).map((name) => byName.get(name)).filter(Boolean);
  return chosen.length ? chosen : summary.results;
}

/** Mean and interval of one column of a table at each value of its axis; values without a mean are left out. */
export function profile(table, title) {
  const results = table.columns.find((c) => c.title === title)?.results ?? [];
  return results.flatMap((r, i) =>
    r.value === null
      ? []
      : [{ at: table.at[i], mean: r.value, low: r.interval?.[0] ?? r.value, high: r.interval?.[1] ?? r.value }],
  );
}

/**
 * Mean of several profiles, its band one standard deviation between them, at values of the axis that at least half of
 * them have; one alone stays as it is.
 */
export function meanProfile(profiles) {
  if (profiles.length === 1) return profiles[0];
  const places = [...new Set(profiles.flatMap((rows) => rows.map((r) => r.at)))].sort((a, b) => a - b);
  return places.flatMap((at) => {
    const means = profiles.flatMap((rows) => rows.filter((r) => r.at === at).map((r) => r.mean));
    if (means.length * 2 < profiles.length) return [];
    const mean = means.reduce((a, b) => a + b, 0) / means.length;
    const sd = means.length > 1 ? Math.sqrt(means.reduce((a, b) => a + (b - mean) ** 2, 0) / (means.length - 1)) : 0;
    return [{ at, mean, low: mean - sd, high: mean + sd }];
  });
}

/** Force in newtons from which a foot counts as on the ground; the league's run challenge uses the same. */
export const CONTACT_N = 0.01;

/** The recorded paths of an evaluation's first episodes. */
export class Paths {
  /**
   * @param {Map} arrays of trajectories.npz @param {object} ground field of the robot's league @param
   *   {{x_m: number, title: string}[]} lines across it
   */
  constructor(arrays, ground, lines = []) {
    const need = (name) => {
      const array = arrays.get(name);
      if (!array) throw new Error(`trajectories.npz has no array “${name}”`);
      return array;
    };
    const x = need("x");
    [this.count, this.length] = x.shape;
    this.cycle = arrays.get("cycle_s")?.data[0] ?? 0.02;
    this.names = {
      x,
      y: need("y"),
      height: need("height"),
      left: need("left_foot_force"),
      right: need("right_foot_force"),
    };
    this.failed = arrays.get("failed")?.data ?? null;
    this.ground = ground;
    this.lines = lines;
    this.cache = new Map();
  }

  /** Fetch and read them. */
  static async load(file, ground, lines, signal) {
    const response = await request(file.url, { signal, headers: { Accept: "*/*" } });
    return new Paths(await readNpz(await response.arrayBuffer()), ground, lines);
  }

  /** One episode: samples without padding, and how it ended. */
  episode(i) {
    if (this.cache.has(i)) return this.cache.get(i);
    const of = (array) => array.data.subarray(i * this.length, (i + 1) * this.length);
    const rows = Object.fromEntries(Object.entries(this.names).map(([k, v]) => [k, of(v)]));
    let n = rows.x.length;
    while (n > 0 && Number.isNaN(rows.x[n - 1])) n -= 1;
    for (const key of Object.keys(rows)) rows[key] = rows[key].subarray(0, n);
    // A foot that lands on its edge is pushed sideways or down for a moment; that counts as contact.
    for (const key of ["left", "right"]) rows[key] = rows[key].map(Math.abs);
    const dx = rows.x[n - 1] - rows.x[0];
    const dy = rows.y[n - 1] - rows.y[0];
    const distance = Math.hypot(dx, dy);
    const episode = {
      ...rows,
      samples: n,
      seconds: (n - 1) * this.cycle,
      dx,
      dy,
      distance,
      speed: n > 1 ? distance / ((n - 1) * this.cycle) : 0,
      failed: Boolean(this.failed?.[i]),
    };
    this.cache.set(i, episode);
    return episode;
  }

  /** Angle in degrees between an episode's displacement and the mean displacement of all. */
  deviation(i) {
    this.mean ??= this.all().reduce(([x, y], e) => [x + e.dx, y + e.dy], [0, 0]);
    const { dx, dy } = this.episode(i);
    const [mx, my] = this.mean;
    return (Math.abs(Math.atan2(mx * dy - my * dx, mx * dx + my * dy)) * 180) / Math.PI;
  }

  all() {
    return Array.from({ length: this.count }, (_, i) => this.episode(i));
  }
}

/** Note that the gait of an episode includes its fall; null if it did not fall. */
export const fallNote = (episode, seconds) =>
  episode.failed ? `ended in a fall after ${seconds} s; the values below include the fall` : null;

/**
 * Describe the gait between two samples: touchdowns per second, share of time on the ground per foot, share in flight,
 * stride length.
 *
 * @returns {{stepRate: number|null, duty: [number, number], flight: number, stride: number|null, touchdowns: [number,
 *   number]}}
 */
export function gait(episode, cycle, from = 0, to = episode.samples) {
  let flight = 0;
  const ground = [0, 0];
  const touchdowns = [0, 0];
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
  const n = Math.max(1, to - from);
  const seconds = n * cycle;
  const steps = touchdowns[0] + touchdowns[1];
  const last = Math.max(from, to - 1);
  const moved = Math.hypot(episode.x[last] - episode.x[from], episode.y[last] - episode.y[from]);
  return {
    stepRate: steps ? steps / seconds : null,
    duty: [ground[0] / n, ground[1] / n],
    flight: flight / n,
    stride: steps ? (2 * moved) / steps : null,
    touchdowns,
  };
}
