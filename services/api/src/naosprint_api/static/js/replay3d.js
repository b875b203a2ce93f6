/** A recorded episode in three dimensions: the robot from its own shapes, on the field, frame by frame. */

import * as T from "../vendor/three-0.187.0/three.min.js";
import { FieldStage, FOG, patches, sketch } from "./field3d.js";
import { color } from "./theme.js";

const NAO_M = 0.5; // from the feet to the head of the robot that the cameras are made for
const METRES_PER_NEWTON = 0.0018;
const CONTACT_N = 0.01;

/** One recorded episode: what `replay.json` holds, unpacked. */
export class Recording {
  /**
   * @param {object} document @param {number} front axis of a shape's frame that points to the robot's front: 0 for x, 1
   * for y
   */
  constructor(document, front = 1) {
    const { frames, bodies } = document;
    if (document.format !== 2) throw new Error(`this page cannot read replay format ${document.format}`);
    if (!(frames > 0) || document.position_m.length !== frames || document.rotation_wxyz.length !== frames)
      throw new Error("the replay is damaged");
    this.frames = frames;
    this.dt = document.dt_s;
    this.bodies = bodies;
    this.end = document.end;
    this.failed = document.failed;
    this.front = front;
    this.positions = Float32Array.from(document.position_m.flat());
    this.rotations = Float32Array.from(document.rotation_wxyz.flat());
    this.forces = document.foot_force_n;
    this.feet = ["left", "right"].map((side) => this.#lowest(side));
    this.#measure();
  }

  /** Find size and head in the frame in which the robot is tallest: it may lie at the start. */
  #measure() {
    const own = this.bodies.map((_, i) => i).filter((i) => this.bodies[i].name !== "ball");
    let most = 0;
    let heights = [];
    for (let t = 0; t < this.frames; t++) {
      const now = own.map((i) => this.pose(t, i).position[2]);
      const tall = Math.max(...now) - Math.min(...now);
      if (tall >= most) [most, heights] = [tall, now];
    }
    /** Size relative to a NAO. */
    this.size = (most || NAO_M) / NAO_M;
    const height = (i) => heights[own.indexOf(i)];
    const round = own.filter((i) => this.bodies[i].shape === "sphere" && this.bodies[i].side === "centre");
    /** Its highest sphere in the middle; -1 without one. */
    this.head = round.reduce((top, i) => (top < 0 || height(i) > height(top) ? i : top), -1);
  }

  /** The lowest shape of a side in the first frame, its foot; -1 without shapes. */
  #lowest(side) {
    const height = (i) => this.positions[3 * i + 2];
    return this.bodies.reduce((low, b, i) => (b.side === side && (low < 0 || height(i) < height(low)) ? i : low), -1);
  }

  get seconds() {
    return (this.frames - 1) * this.dt;
  }

  /** Torso position at a frame. */
  torso(frame) {
    const at = frame * this.bodies.length * 3;
    return [this.positions[at], this.positions[at + 1], this.positions[at + 2]];
  }

  /** Pose of a body at a frame: position and quaternion x, y, z, w. */
  pose(frame, body) {
    const p = (frame * this.bodies.length + body) * 3;
    const q = (frame * this.bodies.length + body) * 4;
    const r = this.rotations;
    return { position: this.positions.subarray(p, p + 3), rotation: [r[q + 1], r[q + 2], r[q + 3], r[q]] };
  }

  /** Frames at which a foot touches down: 0 left, 1 right. */
  touchdowns(foot) {
    const out = [];
    for (let t = 1; t < this.frames; t++)
      if (Math.abs(this.forces[t][foot]) >= CONTACT_N && Math.abs(this.forces[t - 1][foot]) < CONTACT_N) out.push(t);
    return out;
  }

  /** Where the robot runs at a frame without the sway of its steps: the mean of the torso's x and y over 0.8 s. */
  course() {
    const half = Math.round(0.4 / this.dt);
    const n = this.frames;
    const out = new Float32Array(2 * n);
    const sums = new Float64Array(2 * (n + 1));
    for (let t = 0; t < n; t++) {
      const [x, y] = this.torso(t);
      sums[2 * t + 2] = sums[2 * t] + x;
      sums[2 * t + 3] = sums[2 * t + 1] + y;
    }
    for (let t = 0; t < n; t++) {
      const k = Math.min(half, t, n - 1 - t);
      const a = t - k;
      const b = t + k + 1;
      for (const c of [0, 1]) out[2 * t + c] = (sums[2 * b + c] - sums[2 * a + c]) / (b - a);
    }
    return out;
  }

  /** Direction of the displacement in radians, as a multiple of a quarter turn: that of the marks on the ground. */
  get heading() {
    const [x0, y0] = this.torso(0);
    const [x1, y1] = this.torso(this.frames - 1);
    return Math.hypot(x1 - x0, y1 - y0) < 0.5
      ? 0
      : (Math.round(Math.atan2(y1 - y0, x1 - x0) / (Math.PI / 2)) * Math.PI) / 2;
  }

  /** Speed in m/s over a quarter of a second around a frame. */
  speed(frame) {
    const half = Math.round(0.125 / this.dt);
    const a = Math.max(0, frame - half);
    const b = Math.min(this.frames - 1, frame + half);
    const [xa, ya] = this.torso(a);
    const [xb, yb] = this.torso(b);
    return b > a ? Math.hypot(xb - xa, yb - ya) / ((b - a) * this.dt) : 0;
  }
}

/**
 * Cameras relative to the course of a NAO, metres, scaled for other robots: where from and what is looked at. "field"
 * stands still beside the field.
 */
const CAMERAS = {
  follow: [
    [-0.9, -1.02, 0.4],
    [0.12, 0, -0.07],
  ],
  side: [
    [0.05, -1.4, 0.05],
    [0.05, 0, -0.08],
  ],
  front: [
    [1.3, -0.5, 0.18],
    [0, 0, -0.07],
  ],
};

const checks = () =>
  sketch(16, 128, (c, w, h) => {
    for (let i = 0; i < 2; i++)
      for (let k = 0; k < 16; k++) {
        c.fillStyle = (i + k) % 2 ? "#16191d" : "#ffffff";
        c.fillRect((i * w) / 2, (k * h) / 16, w / 2, h / 16);
      }
  });

const lettering = (text) =>
  sketch(256, 128, (c, w, h) => {
    c.font = `600 92px ${getComputedStyle(document.body).fontFamily}`;
    c.textAlign = "center";
    c.textBaseline = "middle";
    c.fillStyle = "#ffffff";
    c.fillText(text, w / 2, h / 2 + 4);
  });

export class Stage extends FieldStage {
  /**
   * @param {HTMLElement} host @param {Recording} recording @param {object} field of the robot's league
   * @param {{x_m: number, title: string}[]} lines across the field
   */
  constructor(host, recording, field, lines = []) {
    super(host, field, { antialias: true });
    this.recording = recording;
    this.lines = lines;
    this.course = recording.course();
    this.following = true;
    this.showForces = true;
    this.#shadows();
    this.#course();
    this.#robot();
    this.last = this.#anchor(0);
    this.begin();
    this.aim("follow");
    this.show(0);
  }

  #shadows() {
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = T.PCFShadowMap;
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(1024, 1024);
    const wide = 0.9 * Math.max(1, this.recording.size);
    Object.assign(this.sun.shadow.camera, { left: -wide, right: wide, top: wide, bottom: -wide, near: 0.5, far: 8 });
    this.sun.shadow.bias = -0.0004;
    this.sun.shadow.normalBias = 0.004;
    this.sun.shadow.radius = 3;
  }

  /** What belongs to this run: start, metres in its direction, lines, the path and the footprints. */
  #course() {
    const r = this.recording;
    const [x0, y0] = r.torso(0);
    const [x1, y1] = r.torso(r.frames - 1);
    const { heading } = r;
    const [cos, sin] = [Math.cos(heading), Math.sin(heading)];
    const far = Math.max(0, ...this.lines.map((l) => (l.x_m - x0) * cos), (x1 - x0) * cos + (y1 - y0) * sin + 2);
    const across = (along, aside, ...more) => {
      const mesh = this.strip(x0 + along * cos - aside * sin, y0 + along * sin + aside * cos, ...more);
      mesh.rotation.z = heading;
      return mesh;
    };
    this.tick = this.painted({ opacity: 0.28 });
    this.letters = [];
    for (let m = 1; m < far - 0.3; m++) {
      const five = m % 5 === 0;
      across(m, 0, five ? 0.035 : 0.015, five ? 3 : 1.6, this.tick, 2);
      if (!five) continue;
      const material = this.painted({ map: lettering(`${m} m`), opacity: 0.75 });
      // On both sides of the lane, to be read from where the cameras stand.
      for (const side of [-1, 1]) across(m, side * 1.9, 1, 0.5, material, 2);
      this.letters.push(material);
    }
    this.gate = this.painted({ opacity: 0.9 });
    across(0, 0, 0.06, 4, this.gate, 3);
    for (const line of this.lines) this.strip(line.x_m, y0, 0.5, 4, this.painted({ map: checks(), opacity: 0.9 }), 3);
    const points = [];
    const index = [];
    for (let t = 0; t < r.frames; t++) {
      const [x, y] = r.torso(t);
      const before = r.torso(Math.max(0, t - 1));
      const after = r.torso(Math.min(r.frames - 1, t + 1));
      const dx = after[0] - before[0];
      const dy = after[1] - before[1];
      const length = Math.hypot(dx, dy) || 1;
      const nx = (-dy / length) * 0.008;
      const ny = (dx / length) * 0.008;
      points.push(x + nx, y + ny, 0, x - nx, y - ny, 0);
      if (t) index.push(2 * t - 2, 2 * t - 1, 2 * t, 2 * t, 2 * t - 1, 2 * t + 1);
    }
    this.trail = this.painted({ opacity: 0.85, side: T.DoubleSide });
    this.path = new T.Mesh(
      new T.BufferGeometry().setAttribute("position", new T.Float32BufferAttribute(points, 3)).setIndex(index),
      this.trail,
    );
    this.path.position.z = 0.0018;
    this.path.renderOrder = 3;
    this.path.frustumCulled = false;
    this.scene.add(this.path);
    this.prints = [];
    this.ink = [0, 1].map(() => this.painted({ opacity: 0.5 }));
    for (const foot of [0, 1]) {
      const body = r.feet[foot];
      if (body < 0) continue;
      const { shape, size_m: size } = r.bodies[body];
      const [wide, long] = shape === "box" ? [size[1 - r.front], size[r.front]] : [0.08, 0.16];
      for (const frame of r.touchdowns(foot)) {
        const { position, rotation } = r.pose(frame, body);
        const ahead = new T.Vector3(1 - r.front, r.front, 0).applyQuaternion(new T.Quaternion(...rotation));
        const print = this.strip(position[0], position[1], wide * 0.8, long, this.ink[foot], 2);
        print.rotation.z = Math.atan2(ahead.y, ahead.x) - Math.PI / 2;
        this.prints.push({ frame, print });
      }
    }
  }

  /** The robot from its shapes. What shows its face is added to the head and the torso. */
  #robot() {
    const plastic = (options) => new T.MeshStandardMaterial({ roughness: 0.42, metalness: 0, ...options });
    const { feet, head, front, bodies } = this.recording;
    this.shell = plastic();
    this.panel = plastic({ roughness: 0.55 });
    this.joint = plastic({ roughness: 0.7 });
    this.glow = new T.MeshBasicMaterial();
    this.sides = [plastic(), plastic()];
    this.leather = plastic({ roughness: 0.6, map: patches() });
    const materialOf = (body, i) => {
      if (body.name === "ball") return this.leather;
      if (feet.includes(i)) return this.sides[body.side === "left" ? 0 : 1];
      if (body.shape === "box" || i === head) return this.shell;
      return body.shape === "sphere" || body.side === "centre" ? this.joint : this.panel;
    };
    this.parts = bodies.map((body, i) => {
      const [a, b, c] = body.size_m;
      // Spheres between two joints touch nothing; drawn larger, they look like joints.
      const geometry =
        {
          box: () => new T.RoundedBoxGeometry(a, b, c, 4, Math.min(a, b, c) * 0.3),
          capsule: () => new T.CapsuleGeometry(a, b, 8, 20).rotateX(Math.PI / 2),
          cylinder: () => new T.CylinderGeometry(a, a, b, 28).rotateX(Math.PI / 2),
        }[body.shape]?.() ?? new T.SphereGeometry(Math.max(a, 0.021), 32, 24);
      const mesh = new T.Mesh(geometry, materialOf(body, i));
      mesh.castShadow = mesh.receiveShadow = true;
      this.scene.add(mesh);
      return mesh;
    });
    // Faces are built looking along y.
    const facing = (part) => {
      const group = new T.Group();
      group.rotation.z = front ? 0 : -Math.PI / 2;
      part.add(group);
      return group;
    };
    if (head >= 0) this.#face(facing(this.parts[head]), bodies[head].size_m[0]);
    // Some robots have no shape between torso and head.
    if (head >= 0 && bodies[0]?.shape === "box") {
      const radius = bodies[head].size_m[0] * 0.4;
      this.neck = new T.Mesh(new T.CylinderGeometry(radius, radius, 1, 20), this.joint);
      this.neck.castShadow = true;
      this.scene.add(this.neck);
    }
    if (bodies[0]?.shape === "box") {
      const button = new T.Mesh(new T.CylinderGeometry(0.013, 0.013, 0.008, 24), this.glow);
      button.position.set(0, bodies[0].size_m[front] / 2, bodies[0].size_m[2] * 0.18);
      facing(this.parts[0]).add(button);
    }
    this.arrows = [0, 1].map((side) => {
      const arrow = new T.Group();
      const material = this.sides[side];
      const shaft = new T.Mesh(
        new T.CylinderGeometry(0.007, 0.007, 1, 12).rotateX(Math.PI / 2).translate(0, 0, 0.5),
        material,
      );
      const tip = new T.Mesh(
        new T.CylinderGeometry(0, 0.02, 0.05, 20).rotateX(Math.PI / 2).translate(0, 0, 0.025),
        material,
      );
      arrow.add(shaft, tip);
      this.scene.add(arrow);
      return { arrow, shaft, tip };
    });
  }

  #face(head, radius) {
    const disc = (r, depth, material, [x, y, z]) => {
      const mesh = new T.Mesh(new T.CylinderGeometry(r, r, depth, 28), material);
      const out = new T.Vector3(x, y, z).normalize();
      mesh.quaternion.setFromUnitVectors(new T.Vector3(0, 1, 0), out);
      mesh.position.copy(out).multiplyScalar(radius * 0.985);
      head.add(mesh);
    };
    for (const side of [-1, 1]) {
      disc(radius * 0.24, 0.006, this.joint, [side * 0.42, 0.88, 0.12]);
      disc(radius * 0.16, 0.01, this.glow, [side * 0.42, 0.88, 0.12]);
      disc(radius * 0.42, 0.014, this.panel, [side, 0, 0.05]);
      disc(radius * 0.2, 0.02, this.joint, [side, 0, 0.05]);
    }
    disc(radius * 0.09, 0.008, this.joint, [0, 0.82, 0.57]);
    disc(radius * 0.07, 0.008, this.joint, [0, 0.94, -0.34]);
  }

  paint() {
    const dark = super.paint();
    for (const material of [this.tick, ...this.letters]) material.color.copy(this.chalk.color);
    this.gate.color.set(color("--s5"));
    this.trail.color.set(dark ? "#dfe7ef" : "#1d2a3a");
    this.shell.color.set(dark ? "#dfe4ea" : "#f7f8fa");
    this.panel.color.set(dark ? "#8e98a6" : "#b4bcc7");
    this.joint.color.set("#3c444f");
    this.glow.color.set("#39b8ff");
    [this.sides, this.ink].forEach((pair) =>
      pair.forEach((material, i) => material.color.set(color(i ? "--s2" : "--s1"))),
    );
    return dark;
  }

  fit() {
    super.fit();
    if (this.all) this.aim("field");
  }

  /** Point that the camera looks at in a frame: on the robot's course, at the height of its start. */
  #anchor(frame) {
    const c = this.course;
    const n = this.recording.frames;
    const a = Math.max(0, Math.min(n - 1, Math.floor(frame)));
    const b = Math.min(n - 1, a + 1);
    const mix = frame - a;
    return new T.Vector3(
      c[2 * a] + (c[2 * b] - c[2 * a]) * mix,
      c[2 * a + 1] + (c[2 * b + 1] - c[2 * a + 1]) * mix,
      this.recording.torso(0)[2],
    );
  }

  /** Look from one of CAMERAS or at the whole "field", or stay where the camera is for "free". */
  aim(name) {
    this.following = name in CAMERAS;
    this.all = name === "field";
    if (name === "free") return;
    [this.scene.fog.near, this.scene.fog.far] = this.all ? FOG.field : FOG.near;
    if (this.all) this.lookAtField();
    else {
      const up = new T.Vector3(0, 0, 1);
      const [from, to] = CAMERAS[name].map((offset) =>
        new T.Vector3(...offset).multiplyScalar(this.recording.size).applyAxisAngle(up, this.recording.heading),
      );
      this.controls.target.copy(this.last).add(to);
      this.camera.position.copy(this.last).add(from);
    }
    this.controls.update();
    this.clear(this.following);
    this.render();
  }

  /** Show a moment; `frame` may lie between two recorded ones. */
  show(frame) {
    const r = this.recording;
    const a = Math.max(0, Math.min(r.frames - 1, Math.floor(frame)));
    const b = Math.min(r.frames - 1, a + 1);
    const mix = frame - a;
    const qa = new T.Quaternion();
    const qb = new T.Quaternion();
    this.parts.forEach((mesh, i) => {
      const from = r.pose(a, i);
      const to = r.pose(b, i);
      mesh.position.set(...[0, 1, 2].map((k) => from.position[k] + (to.position[k] - from.position[k]) * mix));
      mesh.quaternion.slerpQuaternions(qa.set(...from.rotation), qb.set(...to.rotation), mix);
    });
    if (this.neck) {
      const { position, quaternion } = this.parts[0];
      const low = new T.Vector3(0, 0, r.bodies[0].size_m[2] * 0.4).applyQuaternion(quaternion).add(position);
      const along = this.parts[r.head].position.clone().sub(low);
      this.neck.position.copy(low).addScaledVector(along, 0.5);
      this.neck.scale.y = along.length();
      this.neck.quaternion.setFromUnitVectors(new T.Vector3(0, 1, 0), along.normalize());
    }
    this.arrows.forEach(({ arrow, shaft, tip }, i) => {
      const force = Math.max(0, r.forces[a][i]);
      const foot = this.parts[r.feet[i]];
      arrow.visible = this.showForces && force > 0.5 && Boolean(foot);
      if (!arrow.visible) return;
      // Beside the foot: in its middle, the leg would hide it.
      const out = i ? 0.075 : -0.075;
      const aside = (r.front ? new T.Vector3(out, 0, 0) : new T.Vector3(0, -out, 0)).applyQuaternion(foot.quaternion);
      const length = force * METRES_PER_NEWTON;
      arrow.position.set(foot.position.x + aside.x, foot.position.y + aside.y, 0.002);
      shaft.scale.z = Math.max(0.001, length - 0.05);
      tip.position.z = Math.max(0, length - 0.05);
      tip.scale.setScalar(Math.min(1, length / 0.05));
    });
    for (const { frame: since, print } of this.prints) print.visible = since <= frame;
    this.path.geometry.setDrawRange(0, 6 * a);
    const now = this.#anchor(frame);
    if (this.following) {
      const moved = now.clone().sub(this.last);
      this.camera.position.add(moved);
      this.controls.target.add(moved);
    }
    this.last = now;
    this.clear(this.following);
    this.dome.position.set(now.x, now.y, 0);
    this.sun.target.position.set(now.x, now.y, 0.2);
    this.sun.position.set(now.x - 1.3, now.y - 1.7, 3.6);
    this.render();
  }
}
