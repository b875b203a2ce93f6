/** Plots of a study as SVG: curves of trials, parallel coordinates, Pareto front. */

import { s } from "./dom.js";
import { axes, path, svg } from "./figures.js";
import { compact, significant } from "./format.js";

const HEIGHT = 300;
const MARGIN = 46;

/** Range of numbers that leaves room around them. */
function range(values) {
  const low = Math.min(...values);
  const high = Math.max(...values);
  const room = (high - low || Math.abs(high) || 1) * 0.06;
  return [low - room, high + room];
}

const known = (value) => value !== null && value !== undefined;

/** Curves of trials: `lines` have x, y, label and token. */
export function curves(width, lines, label) {
  const points = lines.map((line) => line.x.map((x, i) => [x, line.y[i]]).filter(([, y]) => known(y)));
  const all = points.flat();
  if (!all.length)
    return svg(
      width,
      60,
      `${label}: no metrics yet`,
      s("text", { x: 12, y: 34 }, "No training has reported metrics yet."),
    );
  const plane = axes({
    width,
    height: HEIGHT,
    x: [0, Math.max(...all.map(([x]) => x))],
    y: range(all.map(([, y]) => y)),
    xLabel: "Steps",
    yLabel: label,
    xFormat: compact,
    yFormat: (v) => significant(v),
  });
  return svg(
    width,
    HEIGHT,
    `${label} of ${lines.length} trials`,
    plane.group,
    points.map((curve, i) =>
      s("path", {
        d: path(curve.map(([x, y]) => [plane.sx(x), plane.sy(y)])),
        fill: "none",
        stroke: `var(${lines[i].token})`,
        "stroke-width": 1.75,
      }),
    ),
    lines.map((line, i) =>
      s("text", { x: plane.left + 8, y: plane.top + 14 * (i + 1), style: { fill: `var(${line.token})` } }, line.label),
    ),
  );
}

/** One axis of parallel coordinates: its name, the place of a value from 0 to 1, and labels at its ends. */
export function axisOf(name, parameter) {
  if (parameter.type === "choice") {
    const options = parameter.choices.map((choice) => JSON.stringify(choice));
    const last = options.length - 1;
    return {
      name,
      place: (value) => options.indexOf(JSON.stringify(value)) / last,
      low: options[0],
      high: options[last],
    };
  }
  const scale = parameter.log ? Math.log : (v) => v;
  const [a, b] = [scale(parameter.low), scale(parameter.high)];
  return {
    name,
    place: (v) => (scale(v) - a) / (b - a),
    low: significant(parameter.low),
    high: significant(parameter.high),
  };
}

/** Parallel coordinates: one line per complete trial through its settings to its first objective. */
export function coordinates(width, study) {
  const trials = study.trials.filter((trial) => trial.state === "complete");
  const values = trials.map((trial) => trial.values[0]);
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const settings = Object.entries(study.spec.space).map(([name, parameter]) => axisOf(name, parameter));
  const result = {
    name: study.spec.objectives[0].metric,
    place: (v) => (high > low ? (v - low) / (high - low) : 0.5),
    low: significant(low),
    high: significant(high),
  };
  const columns = [...settings, result];
  const x = (i) => MARGIN + (i / (columns.length - 1)) * (width - 2 * MARGIN);
  const y = (share) => HEIGHT - 40 - share * (HEIGHT - 80);
  const line = (trial) =>
    path(
      columns.map((column, i) => [
        x(i),
        y(column.place(i < settings.length ? trial.params[column.name] : trial.values[0])),
      ]),
    );
  const best = new Set(study.best);
  const drawn = [...trials].sort((a, b) => best.has(a.number) - best.has(b.number));
  return svg(
    width,
    HEIGHT,
    `Settings and ${result.name} of ${trials.length} trials`,
    columns.map((column, i) => [
      s("line", { class: "axis", x1: x(i), x2: x(i), y1: y(0), y2: y(1) }),
      s("text", { x: x(i), y: 16, "text-anchor": "middle" }, column.name),
      s("text", { x: x(i), y: y(1) - 6, "text-anchor": "middle" }, column.high),
      s("text", { x: x(i), y: y(0) + 16, "text-anchor": "middle" }, column.low),
    ]),
    drawn.map((trial) =>
      s(
        "path",
        {
          d: line(trial),
          fill: "none",
          stroke: best.has(trial.number) ? "var(--s2)" : "var(--s1)",
          "stroke-width": best.has(trial.number) ? 2.5 : 1,
          opacity: best.has(trial.number) ? 1 : 0.45,
        },
        s("title", null, `Trial ${trial.number}: ${significant(trial.values[0], 4)}`),
      ),
    ),
  );
}

/** The first two objectives of the complete trials against each other; those of the Pareto front stand out. */
export function front(width, study) {
  const trials = study.trials.filter((trial) => trial.state === "complete");
  const [first, second] = study.spec.objectives;
  const plane = axes({
    width,
    height: HEIGHT,
    x: range(trials.map((trial) => trial.values[0])),
    y: range(trials.map((trial) => trial.values[1])),
    xLabel: first.metric,
    yLabel: second.metric,
    xFormat: (v) => significant(v),
    yFormat: (v) => significant(v),
  });
  const best = new Set(study.best);
  return svg(
    width,
    HEIGHT,
    `${first.metric} and ${second.metric} of ${trials.length} trials, ${best.size} on the Pareto front`,
    plane.group,
    trials.map((trial) =>
      s(
        "circle",
        {
          cx: plane.sx(trial.values[0]),
          cy: plane.sy(trial.values[1]),
          r: best.has(trial.number) ? 5 : 3,
          fill: best.has(trial.number) ? "var(--s2)" : "var(--s1)",
        },
        s("title", null, `Trial ${trial.number}: ${trial.values.map((v) => significant(v, 4)).join(", ")}`),
      ),
    ),
  );
}
