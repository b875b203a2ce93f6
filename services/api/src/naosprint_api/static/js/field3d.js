/** A league's field in three dimensions: sky, grass, lines, goals and a camera; what moves on it is added by others. */

import * as T from "../vendor/three-0.187.0/three.min.js";
import { color, onTheme } from "./theme.js";

const FIELD_VIEW = [0, -0.76, 0.65]; // direction from the middle of the field to the camera that shows all of it
const TURF_M = [140, 120];
const COARSE_LINE_M = 0.12;
export const FOG = { near: [14, 46], field: [60, 130] };

/** A canvas to draw a texture on. */
export function sketch(width, height, draw) {
  const canvas = document.createElement("canvas");
  canvas.width = width;
  canvas.height = height;
  draw(canvas.getContext("2d"), width, height);
  const texture = new T.CanvasTexture(canvas);
  texture.colorSpace = T.SRGBColorSpace;
  texture.anisotropy = 8;
  return texture;
}

/** Grass in shades of grey, to be tinted: two mown strips of a metre and the same grain at every visit. */
function grass() {
  const texture = sketch(512, 256, (c, w, h) => {
    let state = 7;
    const random = () => {
      state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
      return state / 2 ** 32;
    };
    const picture = c.createImageData(w, h);
    for (let i = 0; i < w * h; i++) {
      const strip = i % w < w / 2 ? 0 : 13;
      const value = 236 - strip + (random() - 0.5) * 8;
      picture.data.set([value, value, value, 255], 4 * i);
    }
    c.putImageData(picture, 0, 0);
  });
  texture.wrapS = texture.wrapT = T.RepeatWrapping;
  texture.repeat.set(TURF_M[0] / 2, TURF_M[1]);
  return texture;
}

/** The same strips without a texture. */
function stripes() {
  const [length, width] = TURF_M;
  const points = [];
  const shades = [];
  for (let i = 0; i < length; i++) {
    const [x, y] = [i - length / 2, width / 2];
    points.push(x, -y, 0, x + 1, -y, 0, x + 1, y, 0, x, -y, 0, x + 1, y, 0, x, y, 0);
    shades.push(...new Array(18).fill(i % 2 ? 0.84 : 0.75));
  }
  return new T.BufferGeometry()
    .setAttribute("position", new T.Float32BufferAttribute(points, 3))
    .setAttribute("color", new T.Float32BufferAttribute(shades, 3));
}

/** A ball's surface, whose patches show how it turns. */
export const patches = () =>
  sketch(128, 64, (c, w, h) => {
    c.fillStyle = "#ffffff";
    c.fillRect(0, 0, w, h);
    c.fillStyle = "#2b3038";
    for (let row = 0; row < 3; row++)
      for (let k = 0; k < 4; k++) {
        c.beginPath();
        c.ellipse(((k + (row % 2) / 2 + 0.25) * w) / 4, ((row + 0.5) * h) / 3, w / 20, h / 12, 0, 0, 2 * Math.PI);
        c.fill();
      }
  });

/** A field in an element of the page. What extends it adds to `scene`, and calls `begin` when all is there. */
export class FieldStage {
  /**
   * @param {HTMLElement} host @param {object} field of a league @param {object} options of the renderer
   * @param {boolean} plain without textures on what fills the picture, for browsers that draw in software
   */
  constructor(host, field, options, plain = false) {
    this.host = host;
    this.field = field;
    this.plain = plain;
    this.renderer = new T.WebGLRenderer({ powerPreference: "low-power", ...options });
    if (!plain) this.renderer.toneMapping = T.NeutralToneMapping;
    this.renderer.setPixelRatio(Math.min(2, devicePixelRatio));
    host.append(this.renderer.domElement);
    this.scene = new T.Scene();
    this.scene.fog = new T.Fog(0, ...FOG.near);
    this.camera = new T.PerspectiveCamera(36, 1, 0.1, 160);
    this.camera.up.set(0, 0, 1);
    this.controls = new T.OrbitControls(this.camera, this.renderer.domElement);
    this.controls.maxPolarAngle = Math.PI * 0.495;
    this.controls.minDistance = 0.5;
    this.controls.maxDistance = 70;
    this.controls.addEventListener("change", () => this.render());
    this.#sky();
    this.#ground();
  }

  /** Take over the theme's colours and the host's size, now and whenever they change. */
  begin() {
    this.paint();
    this.stopTheme = onTheme(() => {
      this.paint();
      this.render();
    });
    this.observer = new ResizeObserver(() => this.fit());
    this.observer.observe(this.host);
    this.fit();
  }

  #sky() {
    this.light = new T.HemisphereLight(0xffffff, 0xffffff, 1);
    this.sun = new T.DirectionalLight(0xffffff, 1);
    const geometry = new T.SphereGeometry(90, 32, 32).rotateX(Math.PI / 2);
    geometry.setAttribute(
      "color",
      new T.Float32BufferAttribute(new Float32Array(geometry.attributes.position.count * 3), 3),
    );
    this.dome = new T.Mesh(
      geometry,
      new T.MeshBasicMaterial({ vertexColors: true, side: T.BackSide, fog: false, depthWrite: false }),
    );
    this.dome.renderOrder = -2;
    this.dome.visible = !this.plain;
    this.scene.add(this.light, this.sun, this.sun.target, this.dome);
  }

  /** Put a flat rectangle on the ground; later layers lie over earlier ones. */
  strip(x, y, length, width, material, layer = 1) {
    const mesh = new T.Mesh(new T.PlaneGeometry(length, width), material);
    mesh.position.set(x, y, 0.0006 * layer);
    mesh.renderOrder = layer;
    this.scene.add(mesh);
    return mesh;
  }

  /** A material of what is painted on the ground; without depth of its own, so that nothing flickers far away. */
  painted(options = {}) {
    return new T.MeshBasicMaterial({ transparent: true, depthWrite: false, ...options });
  }

  #ground() {
    // Drawn first and without depth: what is painted on a plane of this size would win and lose against it by rounding.
    this.turf = this.plain
      ? new T.Mesh(stripes(), new T.MeshBasicMaterial({ vertexColors: true, depthWrite: false, depthTest: false }))
      : new T.Mesh(new T.PlaneGeometry(...TURF_M), new T.MeshLambertMaterial({ map: grass(), depthWrite: false }));
    this.turf.renderOrder = -1;
    this.turf.receiveShadow = true;
    this.scene.add(this.turf);
    this.chalk = this.painted();
    this.posts = new T.MeshStandardMaterial({ roughness: 0.4 });
    this.net = new T.LineBasicMaterial({ transparent: true, opacity: 0.4 });
    const { line_width_m: width, circle_radius_m: radius, penalty_spot_m: spot, length_m: length } = this.field;
    const line = this.plain ? Math.max(width, COARSE_LINE_M) : width; // thinner ones would fall between coarse pixels
    for (const [x0, y0, x1, y1] of this.field.lines)
      this.strip((x0 + x1) / 2, (y0 + y1) / 2, Math.abs(x1 - x0) + line, Math.abs(y1 - y0) + line, this.chalk);
    const round = (geometry, x = 0) => {
      const mesh = new T.Mesh(geometry, this.chalk);
      mesh.position.set(x, 0, 0.0006);
      this.scene.add(mesh);
    };
    round(new T.RingGeometry(radius - line / 2, radius + line / 2, 96));
    if (spot) for (const side of [-1, 1]) round(new T.RingGeometry(0, line, 24), side * (length / 2 - spot));
    this.goals = this.field.goal ? [-1, 1].map((side) => this.#goal(side)) : [];
  }

  #goal(side) {
    const { width_m: w, height_m: h, depth_m: d, post_radius_m: r } = this.field.goal;
    const goal = new T.Group();
    const bar = (length, x, y, z, turn) => {
      const mesh = new T.Mesh(new T.CylinderGeometry(r, r, length, 16), this.posts);
      mesh.position.set(x, y, z);
      if (turn) mesh.rotation.x = Math.PI / 2;
      goal.add(mesh);
    };
    for (const y of [-1, 1]) bar(h, 0, (y * w) / 2, h / 2, true);
    bar(w + 2 * r, 0, 0, h, false);
    const points = [];
    const mesh = 0.12;
    const columns = Math.round(w / mesh);
    const rows = Math.round(h / mesh);
    const deep = Math.round(d / mesh);
    const y = (i) => -w / 2 + (w * i) / columns;
    const z = (i) => (h * i) / rows;
    const x = (i) => (d * i) / deep;
    for (let i = 0; i <= columns; i++) points.push(d, y(i), 0, d, y(i), h, 0, y(i), h, d, y(i), h);
    for (let i = 0; i <= rows; i++)
      points.push(d, -w / 2, z(i), d, w / 2, z(i), 0, -w / 2, z(i), d, -w / 2, z(i), 0, w / 2, z(i), d, w / 2, z(i));
    for (let i = 0; i <= deep; i++)
      points.push(x(i), -w / 2, 0, x(i), -w / 2, h, x(i), w / 2, 0, x(i), w / 2, h, x(i), -w / 2, h, x(i), w / 2, h);
    goal.add(
      new T.LineSegments(
        new T.BufferGeometry().setAttribute("position", new T.Float32BufferAttribute(points, 3)),
        this.net,
      ),
    );
    goal.position.x = (side * this.field.length_m) / 2;
    if (side < 0) goal.rotation.z = Math.PI;
    this.scene.add(goal);
    return goal;
  }

  /** Take over the theme's colours; returns whether it is dark. */
  paint() {
    const dark = new T.Color(color("--surface")).getHSL({}).l < 0.5;
    const horizon = new T.Color(dark ? "#1b242e" : "#e9f0f7");
    const zenith = new T.Color(dark ? "#0a0e14" : "#9dc3e8");
    const { position, color: shade } = this.dome.geometry.attributes;
    const mixed = new T.Color();
    for (let i = 0; i < position.count; i++) {
      mixed.lerpColors(horizon, zenith, Math.min(1, Math.max(0, position.getZ(i) / 90) ** 0.6));
      shade.setXYZ(i, mixed.r, mixed.g, mixed.b);
    }
    shade.needsUpdate = true;
    this.scene.fog.color.copy(horizon);
    this.turf.material.color.set(dark ? "#2f5a3c" : "#6fae6c");
    if (this.plain) {
      this.turf.material.color.multiplyScalar(dark ? 0.92 : 1.19); // what the lights make of it
      this.scene.background = horizon;
    }
    this.light.color.set(dark ? "#c9d8ee" : "#ffffff");
    this.light.groundColor.set(dark ? "#223127" : "#93b58c");
    this.light.intensity = dark ? 1.1 : 1.75;
    this.sun.intensity = dark ? 2.1 : 2.3;
    for (const material of [this.chalk, this.net]) material.color.set(dark ? "#a9bdae" : "#ffffff");
    this.posts.color.set(dark ? "#c6ced6" : "#ffffff");
    return dark;
  }

  fit() {
    const { clientWidth: w, clientHeight: h } = this.host;
    if (!w || !h) return;
    this.renderer.setSize(w, h);
    this.camera.aspect = w / h;
    // On a narrow view what is looked at must not fill all of it, and the field should fit.
    this.camera.fov = this.camera.aspect < 1.2 ? 44 : 36;
    this.camera.updateProjectionMatrix();
    this.render();
  }

  /** Look at the whole field. */
  lookAtField() {
    const half = Math.tan((this.camera.fov * Math.PI) / 360);
    const { length_m: length, width_m: width } = this.field;
    this.controls.target.set(0, 0, 0);
    this.camera.position
      .set(...FIELD_VIEW)
      .multiplyScalar(Math.max((0.6 * length) / (half * this.camera.aspect), (0.36 * width) / half));
  }

  /** A goal right before the camera would hide what is looked at. */
  clear(following = true) {
    for (const goal of this.goals)
      goal.visible =
        !following ||
        Math.abs(goal.position.x - this.camera.position.x) > 1.6 ||
        Math.abs(this.camera.position.y) > this.field.goal.width_m;
  }

  render() {
    if (this.gone || this.pending) return;
    this.pending = requestAnimationFrame(() => {
      this.pending = 0;
      if (!this.gone) {
        this.renderer.render(this.scene, this.camera);
        this.drawn = (this.drawn ?? 0) + 1;
      }
    });
  }

  destroy() {
    this.gone = true;
    cancelAnimationFrame(this.pending);
    this.observer.disconnect();
    this.stopTheme();
    this.controls.dispose();
    this.scene.traverse((o) => {
      o.geometry?.dispose();
      o.material?.map?.dispose();
      o.material?.dispose?.();
    });
    this.renderer.dispose();
    this.renderer.forceContextLoss();
    this.renderer.domElement.remove();
  }
}
