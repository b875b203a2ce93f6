/** The field of a league from above with all robots and the ball; one unit of the drawing is a metre. */

import { s } from "./dom.js";

const MARGIN = 3;
const RADIUS = 0.7;

export class Pitch {
  /** @param {object} field of the league @param {string} label for readers of the screen */
  constructor(field, label) {
    const { length_m: length, width_m: width, line_width_m: line, circle_radius_m: circle, goal } = field;
    const box = [-length / 2 - MARGIN, -width / 2 - MARGIN, length + 2 * MARGIN, width + 2 * MARGIN];
    this.robots = new Map();
    this.bodies = s("g");
    this.ball = s("circle", { class: "ball", r: 0.35 });
    const goals = [-1, 1].map((side) =>
      s("rect", {
        x: side < 0 ? -length / 2 - goal.depth_m : length / 2,
        y: -goal.width_m / 2,
        width: goal.depth_m,
        height: goal.width_m,
      }),
    );
    this.element = s(
      "svg",
      { class: "pitch", viewBox: box.join(" "), role: "img", "aria-label": label },
      s("rect", { class: "turf", x: box[0], y: box[1], width: box[2], height: box[3] }),
      s(
        "g",
        { class: "lines", "stroke-width": line },
        field.lines.map(([x1, y1, x2, y2]) => s("line", { x1, y1: -y1, x2, y2: -y2 })),
        s("circle", { r: circle }),
        goals,
      ),
      this.bodies,
      this.ball,
    );
  }

  /** Show `{ball: [x, y], players: [[team, number, x, y, heading, lies], ...]}`; y points up, as on the field. */
  show({ ball, players }) {
    const here = new Set();
    for (const [team, number, x, y, heading, lies] of players) {
      const key = `${team}-${number}`;
      here.add(key);
      const { group, nose } = this.robots.get(key) ?? this.#robot(key, team, number);
      group.setAttribute("transform", `translate(${x} ${-y})`);
      nose.setAttribute("transform", `rotate(${(-heading * 180) / Math.PI})`);
      group.setAttribute("data-lies", String(Boolean(lies)));
    }
    for (const [key, { group }] of this.robots) group.toggleAttribute("hidden", !here.has(key));
    this.ball.setAttribute("cx", ball[0]);
    this.ball.setAttribute("cy", -ball[1]);
  }

  #robot(key, team, number) {
    const nose = s("path", { d: `M0 ${-RADIUS}L${1.7 * RADIUS} 0L0 ${RADIUS}z` });
    const group = s(
      "g",
      { class: "robot", "data-team": team },
      nose,
      s("circle", { r: RADIUS }),
      s("text", { dy: "0.35em" }, number),
    );
    this.bodies.append(group);
    const robot = { group, nose };
    this.robots.set(key, robot);
    return robot;
  }
}
