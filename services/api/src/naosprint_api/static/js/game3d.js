/** A game in three dimensions: all robots of both teams from their shapes, and the ball, on the field. */

import * as T from "../vendor/three-0.187.0/three.min.js";
import { FieldStage, FOG, patches, sketch } from "./field3d.js";
import { color } from "./theme.js";

const MODELS = new Map([
  [23, "t1"],
  [22, "k1"],
]); // robots by their number of joints
const SOFTWARE = /swiftshader|llvmpipe|software|basic render/i;
const SLOW_S = 1 / 31; // a frame that takes longer makes the picture coarser
const COARSEST = 0.5; // pixels of the picture to those of the page
const SHADOW = 0.004; // height above the ground, over all that is painted there
const BALL_SWAY_S = 0.6; // half the time over which the cameras' way is averaged
const UP = new T.Vector3(0, 0, 1);

/** Names of the robot's shapes and joints by which a log's angles are drawn. */
export async function figureOf(log) {
  const name = MODELS.get(log.width);
  if (!name) throw new Error("the log has no joints of a robot that can be drawn");
  const answer = await fetch(new URL(`../robots/${name}.json`, import.meta.url));
  if (!answer.ok) throw new Error(`the robot's shapes could not be loaded: ${answer.status}`);
  return answer.json();
}

/** Whether this browser draws WebGL without a graphics processor. */
function isSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const named = gl?.getExtension("WEBGL_debug_renderer_info");
  const found = SOFTWARE.test(named ? gl.getParameter(named.UNMASKED_RENDERER_WEBGL) : "");
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return found;
}

/** Projection of everything to the ground along the sun's rays. */
function shadowOf(sun) {
  const { x, y, z } = sun;
  return new T.Matrix4().set(1, 0, -x / z, 0, 0, 1, -y / z, 0, 0, 0, 0, SHADOW, 0, 0, 0, 1);
}

/** Surface of a shape; the number of triangles grows with `detail`. */
function solid({ kind, size_m: [a, b, c] }, detail) {
  const around = 6 + 3 * detail;
  if (kind === "box") return new T.RoundedBoxGeometry(a, b, c, detail, Math.min(a, b, c) * 0.3);
  if (kind === "capsule") return new T.CapsuleGeometry(a, b, 1 + detail, around).rotateX(Math.PI / 2);
  if (kind === "cylinder") return new T.CylinderGeometry(a, a, b, around).rotateX(Math.PI / 2);
  return new T.SphereGeometry(a, around + 2, around);
}

/** All robots of a game, which have the same shapes: each shape is drawn once for all of them. */
class Figures {
  /**
   * @param {object} figure joints and shapes of a robot @param {number} count of robots
   * @param {T.Matrix4} projection from a shape to its shadow @param {boolean} fine with all details
   */
  constructor(figure, count, projection, fine) {
    this.figure = figure;
    this.group = new T.Group();
    this.shade = new T.MeshBasicMaterial({
      color: 0,
      transparent: true,
      opacity: 0.32,
      depthWrite: false,
      side: T.DoubleSide,
      // where one shadow is, another does not make it darker
      stencilWrite: true,
      stencilRef: 1,
      stencilFunc: 517, // NotEqual
      stencilZPass: 7681, // Replace
    });
    this.skin = new T.MeshLambertMaterial();
    this.frames = figure.joints.map(() => new T.Matrix4());
    this.angles = new Float32Array(figure.joints.length);
    this.turned = new T.Matrix4();
    this.torso = new T.Matrix4();
    this.parts = figure.shapes.map((shape) => {
      const mesh = new T.InstancedMesh(solid(shape, fine ? 3 : 1), this.skin, count);
      mesh.instanceMatrix.setUsage(T.DynamicDrawUsage);
      mesh.frustumCulled = false;
      this.group.add(mesh);
      if (fine) this.#cast(mesh, projection);
      const [x, y, z] = shape.at;
      const [w, a, b, c] = shape.turn;
      const local = new T.Matrix4().compose(
        new T.Vector3(x, y, z),
        new T.Quaternion(a, b, c, w),
        new T.Vector3(1, 1, 1),
      );
      return { mesh, local, shape };
    });
    // one disc below each robot where the shadows of all its shapes would take too long
    this.discs = fine ? null : new T.InstancedMesh(new T.RingGeometry(0, 0.28, 12), this.shade, count);
    if (fine) return;
    this.discs.frustumCulled = false;
    this.discs.renderOrder = 4;
    this.group.add(this.discs);
  }

  /** Draw the shadows of a shape of all robots. */
  #cast(mesh, projection) {
    const shadow = new T.InstancedMesh(mesh.geometry, this.shade, mesh.count);
    shadow.instanceMatrix = mesh.instanceMatrix;
    shadow.matrixAutoUpdate = false;
    shadow.matrix.copy(projection);
    shadow.renderOrder = 4;
    shadow.frustumCulled = false;
    this.group.add(shadow);
  }

  /** Take over the colours: `paint(team, shape)` of each robot's shapes. */
  paint(robots, paint) {
    for (const { mesh, shape } of this.parts) {
      robots.forEach(([team], robot) => mesh.setColorAt(robot, paint(team, shape)));
      mesh.instanceColor.needsUpdate = true;
    }
  }

  /** Put a robot where it was; `angles` of its joints are set before. */
  place(robot, position, rotation) {
    this.torso.makeRotationFromQuaternion(rotation).setPosition(position);
    this.figure.joints.forEach(({ parent, at: [x, y, z], axis }, j) => {
      const angle = this.angles[j];
      if (axis === "x") this.turned.makeRotationX(angle);
      else if (axis === "y") this.turned.makeRotationY(angle);
      else this.turned.makeRotationZ(angle);
      this.turned.setPosition(x, y, z);
      this.frames[j].multiplyMatrices(parent < 0 ? this.torso : this.frames[parent], this.turned);
    });
    for (const { mesh, local, shape } of this.parts) {
      this.turned.multiplyMatrices(shape.joint < 0 ? this.torso : this.frames[shape.joint], local);
      mesh.setMatrixAt(robot, this.turned);
    }
    this.discs?.setMatrixAt(robot, this.turned.makeTranslation(position.x + 0.1, position.y + 0.14, SHADOW));
  }

  hide(robot) {
    for (const mesh of this.group.children) mesh.setMatrixAt(robot, this.turned.makeScale(0, 0, 0));
  }

  /** Draw what was placed. */
  update() {
    for (const mesh of this.group.children) mesh.instanceMatrix.needsUpdate = true;
  }
}

/** A plate with a uniform number, which faces the camera. */
function plate(number, material) {
  const own = material.clone();
  own.map = sketch(64, 64, () => {});
  const mesh = new T.Mesh(new T.PlaneGeometry(1, 1), own);
  mesh.renderOrder = 6;
  mesh.paint = (fill) => {
    const c = own.map.image.getContext("2d");
    c.fillStyle = fill;
    c.beginPath();
    c.arc(32, 32, 31, 0, 2 * Math.PI);
    c.fill();
    c.font = `700 42px ${getComputedStyle(document.body).fontFamily}`;
    c.textAlign = "center";
    c.textBaseline = "middle";
    c.fillStyle = "#ffffff";
    c.fillText(String(number), 32, 35);
    own.map.needsUpdate = true;
  };
  return mesh;
}

export class GameStage extends FieldStage {
  /** @param {HTMLElement} host @param {GameLog} log @param {object} figure of `figureOf` @param {object} field */
  constructor(host, log, figure, field) {
    const coarse = isSoftware();
    super(host, field, { antialias: !coarse, stencil: true }, coarse);
    if (coarse) this.renderer.setPixelRatio(1);
    this.ratio = this.renderer.getPixelRatio();
    this.log = log;
    this.sun.position.set(-1.3, -1.7, 3.6);
    this.projection = shadowOf(this.sun.position);
    this.figures = new Figures(figure, log.robots.length, this.projection, !coarse);
    this.scene.add(this.figures.group);
    this.#ball();
    this.plates = log.robots.map(([, number]) => {
      const mesh = plate(number, this.painted());
      this.scene.add(mesh);
      return mesh;
    });
    this.last = { at: new T.Vector3(), turn: 0 };
    this.begin();
    this.aim("ball");
    this.show(0);
  }

  #ball() {
    const radius = this.field.ball_radius_m;
    this.ball = new T.Mesh(new T.SphereGeometry(radius, 20, 14), new T.MeshLambertMaterial({ map: patches() }));
    this.ballShadow = new T.Mesh(this.ball.geometry, this.figures.shade);
    this.ballShadow.matrixAutoUpdate = false;
    this.ballShadow.renderOrder = 4;
    this.ring = new T.Mesh(new T.RingGeometry(0.85, 1, 32), this.painted({ opacity: 0.9 }));
    this.ring.renderOrder = 5;
    this.scene.add(this.ball, this.ballShadow, this.ring);
  }

  paint() {
    const dark = super.paint();
    const names = ["--s1", "--s2"].map(color);
    const teams = names.map((name) => new T.Color(name));
    const shell = new T.Color(dark ? "#dfe4ea" : "#f2f4f7");
    const limb = new T.Color(dark ? "#8e98a6" : "#b4bcc7");
    const joint = new T.Color("#3c444f");
    const part = { torso: teams, feet: teams, head: [shell, shell], joint: [joint, joint], limb: [limb, limb] };
    this.figures.paint(this.log.robots, (team, shape) => part[shape.part][team]);
    this.plates.forEach((mesh, robot) => mesh.paint(names[this.log.robots[robot][0]]));
    this.ring.material.color.set(dark ? "#ffd84d" : "#b45309");
    return dark;
  }

  fit() {
    super.fit();
    if (this.view === "field" || this.view === "above") this.aim(this.view);
  }

  /** Look at the "ball", from "above", at the whole "field", after a robot by its number in the log, or "free". */
  aim(view) {
    this.view = view;
    if (view === "free") return;
    const { fog } = this.scene;
    [fog.near, fog.far] = view === "field" || view === "above" ? FOG.field : FOG.near;
    if (view === "field") this.lookAtField();
    else if (view === "above") {
      const half = Math.tan((this.camera.fov * Math.PI) / 360);
      const { length_m: length, width_m: width } = this.field;
      const high = Math.max((0.55 * length) / (half * this.camera.aspect), (0.55 * width) / half);
      this.controls.target.set(0, 0, 0);
      this.camera.position.set(0, -0.001 * high, high);
      [fog.near, fog.far] = [2 * high, 4 * high];
    } else {
      this.last = this.#anchor(this.frame ?? 0);
      const offset = view === "ball" ? new T.Vector3(0, -8.5, 4.2) : new T.Vector3(-3.4, 0, 1.1);
      this.controls.target.copy(this.last.at);
      this.camera.position.copy(this.last.at).add(offset.applyAxisAngle(UP, this.last.turn));
    }
    this.controls.update();
    this.render();
  }

  /** Point that the camera looks at, and the direction of a robot that it follows, without their sway. */
  #anchor(frame) {
    const { log } = this;
    const at = new T.Vector3();
    const ahead = new T.Vector3();
    const point = [0, 0, 0];
    const step = this.step ?? 1;
    const reach = Math.round(BALL_SWAY_S / 0.04 / step);
    const middle = Math.max(0, Math.min(log.frames - 1, Math.round(frame)));
    let found = 0;
    for (let i = Math.max(0, middle - reach); i <= Math.min(log.frames - 1, middle + reach); i++) {
      if (log.half[i] !== log.half[middle]) continue;
      // the weights fall to 0, so that the way has no corners
      const weight = 1 - Math.abs(i - frame) / (reach + 1);
      if (weight <= 0) continue;
      if (this.view === "ball") log.ballAt(i, point);
      else {
        if (!log.isHere(i, this.view)) continue;
        log.torsoAt(i, this.view, point);
        const turn = log.headingAt(i, this.view);
        ahead.x += weight * Math.cos(turn);
        ahead.y += weight * Math.sin(turn);
      }
      at.x += weight * point[0];
      at.y += weight * point[1];
      found += weight;
    }
    if (!found) return this.last;
    at.divideScalar(found).setZ(this.view === "ball" ? 0.3 : 0.8);
    return { at, turn: Math.atan2(ahead.y, ahead.x) };
  }

  /** Move the camera with what it follows. */
  #follow(frame) {
    if (this.view !== "ball" && typeof this.view !== "number") return;
    const now = this.#anchor(frame);
    const offset = this.camera.position.clone().sub(this.controls.target);
    offset.applyAxisAngle(UP, now.turn - this.last.turn);
    this.controls.target.add(now.at).sub(this.last.at);
    this.camera.position.copy(this.controls.target).add(offset);
    this.camera.lookAt(this.controls.target);
    this.last = now;
  }

  /** Show a moment; `frame` may lie between two recorded ones. */
  show(frame) {
    const { log, figures } = this;
    const [a, b, mix] = log.between(frame);
    this.frame = frame;
    const [from, to] = [new T.Quaternion(), new T.Quaternion()];
    const position = new T.Vector3();
    this.#follow(frame);
    this.camera.updateMatrixWorld();
    log.robots.forEach((_, robot) => {
      const here = log.isHere(a, robot);
      this.plates[robot].visible = here;
      if (!here) {
        figures.hide(robot);
        return;
      }
      const later = log.isHere(b, robot) ? b : a;
      const [x, y, z] = log.torsoAt(a, robot);
      position.set(...log.torsoAt(later, robot));
      // who is put elsewhere by the referee does not fly there
      const share = Math.hypot(position.x - x, position.y - y) > 1 ? 0 : mix;
      position.set(x + (position.x - x) * share, y + (position.y - y) * share, z + (position.z - z) * share);
      from.set(...log.turnAt(a, robot)).normalize();
      from.slerp(to.set(...log.turnAt(later, robot)).normalize(), share);
      log.anglesAt(a, later, share, robot, figures.angles);
      figures.place(robot, position, from);
      this.#label(this.plates[robot], position);
    });
    figures.update();
    this.#roll(frame);
    this.dome.position.set(this.camera.position.x, this.camera.position.y, 0);
    this.clear(this.view !== "field" && this.view !== "above");
    this.render();
  }

  #label(mesh, position) {
    const far = this.camera.position.distanceTo(position);
    const size = Math.max(0.12, (this.compact ? 0.032 : 0.022) * far);
    mesh.position.copy(position).setZ(position.z + 0.5 + size / 2);
    mesh.quaternion.copy(this.camera.quaternion);
    mesh.scale.setScalar(size);
  }

  /** Put the ball where it is, turned by its way since the frame shown before. */
  #roll(frame) {
    const { ball, ring, ballShadow } = this;
    const before = ball.position.clone();
    ball.position.set(...this.log.ballAt(frame));
    const way = ball.position.clone().sub(before).setZ(0);
    const length = way.length();
    if (length > 1e-4 && length < 1)
      ball.quaternion.premultiply(
        new T.Quaternion().setFromAxisAngle(UP.clone().cross(way).normalize(), length / this.field.ball_radius_m),
      );
    ball.updateMatrix();
    ballShadow.matrix.multiplyMatrices(this.projection, ball.matrix);
    const far = this.camera.position.distanceTo(ball.position);
    ring.visible = far > 6;
    ring.position.set(ball.position.x, ball.position.y, SHADOW);
    ring.scale.setScalar(Math.max(0.25, 0.014 * far));
  }

  render() {
    if (this.gone || this.pending) return;
    this.pending = requestAnimationFrame((now) => {
      this.pending = 0;
      if (this.gone) return;
      this.#pace(now);
      this.renderer.render(this.scene, this.camera);
      this.drawn = (this.drawn ?? 0) + 1;
    });
  }

  /** Draw fewer pixels while frames take too long. */
  #pace(now) {
    const passed = (now - (this.before ?? now)) / 1000;
    this.before = now;
    if (passed <= 0 || passed > 0.5) return;
    this.taken = (this.taken ?? 0) + passed;
    this.counted = (this.counted ?? 0) + 1;
    if (this.counted < 20) return;
    const mean = this.taken / this.counted;
    this.taken = this.counted = 0;
    if (mean < SLOW_S || this.ratio <= COARSEST) return;
    this.ratio = Math.max(COARSEST, 0.8 * this.ratio);
    this.renderer.setPixelRatio(this.ratio);
  }
}
