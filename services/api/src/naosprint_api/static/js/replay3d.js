/** A recorded episode in three dimensions: the robot of its type from its own bodies, on the field, frame by frame. */

import * as T from "../vendor/three-0.187.0/three.min.js";
import { color, onTheme } from "./theme.js";

const FIELD = { length: 30, width: 20, circle: 2, boxLength: 1.8, boxWidth: 6, goalWidth: 2.1, goalHeight: 0.8 };
const METRES_PER_NEWTON = 0.0025;

/** One recorded episode: what `replay.json` holds, unpacked. */
export class Recording {
  constructor(document) {
    const { frames, bodies } = document;
    if (document.format !== 1) throw new Error(`this page cannot read replay format ${document.format}`);
    if (!(frames > 0) || document.position_m.length !== frames || document.rotation_wxyz.length !== frames) throw new Error("the replay is damaged");
    this.frames = frames;
    this.dt = document.dt_s;
    this.bodies = bodies;
    this.fallen = document.fallen;
    this.arrived = document.arrived;
    this.positions = Float32Array.from(document.position_m.flat());
    this.rotations = Float32Array.from(document.rotation_wxyz.flat());
    this.forces = document.foot_force_n;
    this.feet = [bodies.findIndex((b) => /^l.*foot/i.test(b.name)), bodies.findIndex((b) => /^r.*foot/i.test(b.name))];
  }

  get seconds() { return (this.frames - 1) * this.dt; }

  /** Torso position at a frame. */
  torso(frame) {
    const at = frame * this.bodies.length * 3;
    return [this.positions[at], this.positions[at + 1], this.positions[at + 2]];
  }

  /** Forward speed in m/s over a quarter of a second around a frame. */
  speed(frame) {
    const half = Math.round(0.125 / this.dt), a = Math.max(0, frame - half), b = Math.min(this.frames - 1, frame + half);
    return b > a ? (this.torso(b)[0] - this.torso(a)[0]) / ((b - a) * this.dt) : 0;
  }
}

/** Cameras relative to the torso, metres: where from and what is looked at. */
const CAMERAS = {
  follow: [[-1.15, -1.3, 0.55], [0.12, 0, -0.1]],
  side: [[0, -1.75, 0.12], [0, 0, -0.08]],
  front: [[1.7, -0.45, 0.3], [0, 0, -0.06]],
};

export class Stage {
  /** @param {HTMLElement} host @param {Recording} recording */
  constructor(host, recording, finish) {
    this.host = host;
    this.recording = recording;
    this.finish = finish;
    this.renderer = new T.WebGLRenderer({ antialias: true, powerPreference: "low-power" });
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = T.PCFShadowMap;
    this.renderer.setPixelRatio(Math.min(2, devicePixelRatio));
    host.append(this.renderer.domElement);
    this.scene = new T.Scene();
    this.scene.fog = new T.Fog(0, 9, 30);
    this.camera = new T.PerspectiveCamera(38, 1, 0.05, 120);
    this.camera.up.set(0, 0, 1);
    this.controls = new T.OrbitControls(this.camera, this.renderer.domElement);
    this.controls.maxPolarAngle = Math.PI * 0.495;
    this.controls.minDistance = 0.5;
    this.controls.maxDistance = 30;
    this.controls.addEventListener("change", () => this.render());
    this.following = true;
    this.showForces = true;
    this.#lights();
    this.#ground();
    this.#robot();
    this.#paint();
    this.stopTheme = onTheme(() => { this.#paint(); this.render(); });
    this.observer = new ResizeObserver(() => this.#fit());
    this.observer.observe(host);
    this.last = new T.Vector3(...recording.torso(0));
    this.aim("follow");
    this.#fit();
    this.show(0);
  }

  #lights() {
    this.sky = new T.HemisphereLight(0xffffff, 0x667066, 1.6);
    this.sun = new T.DirectionalLight(0xffffff, 2.2);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(1024, 1024);
    Object.assign(this.sun.shadow.camera, { left: -1.2, right: 1.2, top: 1.2, bottom: -1.2, near: 0.5, far: 8 });
    this.sun.shadow.bias = -0.0006;
    this.scene.add(this.sky, this.sun, this.sun.target);
  }

  #ground() {
    this.turf = new T.Mesh(new T.PlaneGeometry(110, 90), new T.MeshStandardMaterial({ roughness: 1 }));
    this.turf.receiveShadow = true;
    this.chalk = new T.MeshBasicMaterial();
    this.gate = new T.MeshBasicMaterial({ transparent: true, opacity: 0.85 });
    this.faint = new T.LineBasicMaterial({ transparent: true, opacity: 0.55 });
    this.posts = [];
    const strip = (x, y, length, width, material = this.chalk, z = 0.001) => {
      const mesh = new T.Mesh(new T.PlaneGeometry(length, width), material);
      mesh.position.set(x, y, z);
      this.scene.add(mesh);
    };
    const w = 0.05, { length, width } = FIELD;
    strip(0, width / 2, length, w); strip(0, -width / 2, length, w); strip(-length / 2, 0, w, width); strip(length / 2, 0, w, width); strip(0, 0, w, width);
    for (const side of [-1, 1]) {
      const edge = (side * length) / 2, inner = edge - side * FIELD.boxLength;
      strip(inner, 0, w, FIELD.boxWidth); strip((edge + inner) / 2, FIELD.boxWidth / 2, FIELD.boxLength, w); strip((edge + inner) / 2, -FIELD.boxWidth / 2, FIELD.boxLength, w);
      for (const y of [-1, 1]) {
        const post = new T.Mesh(new T.CapsuleGeometry(0.03, FIELD.goalHeight, 2, 8), this.chalk);
        post.rotation.x = Math.PI / 2;
        post.position.set(edge, (y * FIELD.goalWidth) / 2, FIELD.goalHeight / 2);
        this.scene.add(post);
        this.posts.push(post);
      }
    }
    const circle = [], metres = [];
    for (let i = 0; i < 64; i++) circle.push(Math.cos((i / 32) * Math.PI) * FIELD.circle, Math.sin((i / 32) * Math.PI) * FIELD.circle, 0.002);
    // A line across each metre makes the speed visible.
    for (let x = -14; x <= 14; x++) metres.push(x, -1.5, 0.002, x, 1.5, 0.002);
    const lines = (Kind, points, material) => this.scene.add(new Kind(new T.BufferGeometry().setAttribute("position", new T.Float32BufferAttribute(points, 3)), material));
    this.ring = new T.LineBasicMaterial();
    lines(T.LineLoop, circle, this.ring);
    lines(T.LineSegments, metres, this.faint);
    const start = this.recording.torso(0)[0];
    strip(start, 0, 0.06, 4, this.gate, 0.003);
    if (this.finish !== null) strip(this.finish, 0, 0.06, 4, this.gate, 0.003);
    const path = [];
    for (let i = 0; i < this.recording.frames; i++) { const p = this.recording.torso(i); path.push(p[0], p[1], 0.006); }
    this.trail = new T.LineBasicMaterial();
    lines(T.Line, path, this.trail);
    this.scene.add(this.turf);
  }

  #robot() {
    this.shell = new T.MeshStandardMaterial({ roughness: 0.55 });
    this.dark = new T.MeshStandardMaterial({ roughness: 0.7 });
    this.left = new T.MeshStandardMaterial({ roughness: 0.5 });
    this.right = new T.MeshStandardMaterial({ roughness: 0.5 });
    this.parts = this.recording.bodies.map((body, i) => {
      const [a, b, c] = body.size_m;
      const geometry = body.shape === "box" ? new T.RoundedBoxGeometry(a, b, c, 2, Math.min(a, b, c) * 0.16)
        : body.shape === "capsule" ? new T.CapsuleGeometry(a, b, 6, 16).rotateX(Math.PI / 2) : new T.SphereGeometry(a, 24, 16);
      const material = this.recording.feet[0] === i ? this.left : this.recording.feet[1] === i ? this.right : body.shape === "box" || body.name === "head" ? this.shell : this.dark;
      const mesh = new T.Mesh(geometry, material);
      mesh.castShadow = true;
      mesh.receiveShadow = true;
      this.scene.add(mesh);
      return mesh;
    });
    this.arrows = [0, 1].map(() => {
      const arrow = new T.ArrowHelper(new T.Vector3(0, 0, 1), new T.Vector3(), 0.1, 0xffffff, 0.05, 0.035);
      this.scene.add(arrow);
      return arrow;
    });
  }

  /** Take over the theme's colours. */
  #paint() {
    const set = (target, token) => target.set(color(token));
    const dark = new T.Color(color("--surface")).getHSL({}).l < 0.5;
    this.scene.background = new T.Color(color("--sunken"));
    this.scene.fog.color.set(color("--sunken"));
    set(this.turf.material.color, "--pitch");
    this.chalk.color.set(dark ? "#7f9a86" : "#ffffff");
    this.ring.color.set(dark ? "#7f9a86" : "#ffffff");
    set(this.faint.color, "--pitch-line");
    set(this.gate.color, "--s5");
    set(this.trail.color, "--ref");
    this.shell.color.set(dark ? "#d5dbe4" : "#f4f6f9");
    this.dark.color.set(dark ? "#5a6473" : "#8791a0");
    set(this.left.color, "--s1");
    set(this.right.color, "--s2");
    this.arrows?.forEach((arrow, i) => arrow.setColor(new T.Color(color(i ? "--s2" : "--s1"))));
    this.sky.intensity = dark ? 1.1 : 1.7;
  }

  #fit() {
    const { clientWidth: w, clientHeight: h } = this.host;
    if (!w || !h) return;
    this.renderer.setSize(w, h);
    this.camera.aspect = w / h;
    this.camera.updateProjectionMatrix();
    this.render();
  }

  /** Look from one of CAMERAS, or stay where the camera is for "free". */
  aim(name) {
    this.following = name !== "free";
    if (!CAMERAS[name]) return;
    const [from, to] = CAMERAS[name];
    this.controls.target.copy(this.last).add(new T.Vector3(...to));
    this.camera.position.copy(this.last).add(new T.Vector3(...from));
    this.controls.update();
    this.render();
  }

  /** Show a moment; `frame` may lie between two recorded ones. */
  show(frame) {
    const r = this.recording, n = r.bodies.length, a = Math.max(0, Math.min(r.frames - 1, Math.floor(frame))), b = Math.min(r.frames - 1, a + 1), mix = frame - a;
    const qa = new T.Quaternion(), qb = new T.Quaternion();
    this.parts.forEach((mesh, i) => {
      const p = (a * n + i) * 3, q = (b * n + i) * 3, u = (a * n + i) * 4, v = (b * n + i) * 4;
      mesh.position.set(r.positions[p] + (r.positions[q] - r.positions[p]) * mix, r.positions[p + 1] + (r.positions[q + 1] - r.positions[p + 1]) * mix, r.positions[p + 2] + (r.positions[q + 2] - r.positions[p + 2]) * mix);
      qa.set(r.rotations[u + 1], r.rotations[u + 2], r.rotations[u + 3], r.rotations[u]);
      qb.set(r.rotations[v + 1], r.rotations[v + 2], r.rotations[v + 3], r.rotations[v]);
      mesh.quaternion.slerpQuaternions(qa, qb, mix);
    });
    this.arrows.forEach((arrow, i) => {
      const force = Math.max(0, r.forces[a][i]), foot = this.parts[r.feet[i]];
      arrow.visible = this.showForces && force > 0.5 && Boolean(foot);
      if (!arrow.visible) return;
      arrow.position.set(foot.position.x, foot.position.y, 0.004);
      arrow.setLength(force * METRES_PER_NEWTON, 0.04, 0.03);
    });
    const torso = this.parts[0].position;
    if (this.following) {
      const dx = torso.x - this.last.x, dy = torso.y - this.last.y;
      for (const point of [this.camera.position, this.controls.target]) { point.x += dx; point.y += dy; }
    }
    this.last.set(torso.x, torso.y, this.recording.torso(0)[2]);
    // A goal post right before the camera would hide the start.
    for (const post of this.posts) post.visible = post.position.distanceTo(this.camera.position) > 2.5;
    this.sun.target.position.set(torso.x, torso.y, 0);
    this.sun.position.set(torso.x - 1.2, torso.y - 1.6, 3.4);
    this.render();
  }

  render() {
    if (this.gone || this.pending) return;
    this.pending = requestAnimationFrame(() => { this.pending = 0; if (!this.gone) { this.renderer.render(this.scene, this.camera); this.drawn = (this.drawn ?? 0) + 1; } });
  }

  destroy() {
    this.gone = true;
    cancelAnimationFrame(this.pending);
    this.observer.disconnect();
    this.stopTheme();
    this.controls.dispose();
    this.scene.traverse((o) => { o.geometry?.dispose(); o.material?.dispose?.(); });
    this.renderer.dispose();
    this.renderer.forceContextLoss();
    this.renderer.domElement.remove();
  }
}
