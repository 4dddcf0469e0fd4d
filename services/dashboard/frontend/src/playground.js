// The playground: `<figure data-playground="URL">` opens a live session of a world model and draws its answers.
// POST to URL gives { path }, the WebSocket's address with a ticket. The first message is JSON: { dt_s, points,
//   controllers [[x, y, z]], grips [[index]], speed_m_s, reach_m, start [[x, y, z]] }. Then binary frames, little-endian:
//   uint32 tick, uint32 number of the last control, float32 time, uint32 flags, float32 points and controllers [m].
// A control is uint32 number, float32 velocities (grips, 3) [m/s]: a dragged grip is steered towards the pointer.

import {
  BufferAttribute, BufferGeometry, Color, DynamicDrawUsage, PerspectiveCamera, Plane, Points, Raycaster, Scene,
  ShaderMaterial, Vector2, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { colour, onSchemeChange } from "./palette.js";
import { FRAGMENT, VERTEX, grid } from "./points.js";

const HEAD_BYTES = 16;
const PICK_PIXELS = 28;
const GAIN_PER_S = 12; // how fast a grip follows the pointer: it covers the gap in about a tenth of a second
const KEYS = {
  ArrowLeft: [-1, 0, 0], ArrowRight: [1, 0, 0], ArrowUp: [0, 1, 0], ArrowDown: [0, -1, 0], PageUp: [0, 0, 1],
  PageDown: [0, 0, -1],
};
const ENDED = {
  1007: "the session refused a message", 1008: "the session was refused", 1013: "all live sessions are taken",
  4408: "nothing was moved for a while", 4409: "the connection was too slow",
};

/** Round points of one colour, whose places are set from a frame. */
class Cloud {
  constructor(count, role, size) {
    this.role = role;
    this.attribute = new BufferAttribute(new Float32Array(count * 3), 3).setUsage(DynamicDrawUsage);
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", this.attribute);
    this.material = new ShaderMaterial({
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      uniforms: { size: { value: size }, scale: { value: 1 }, tint: { value: new Color() }, opacity: { value: 1 } },
      alphaToCoverage: true,
    });
    this.points = new Points(geometry, this.material);
    this.points.frustumCulled = false;
    this.paint();
  }

  paint() {
    this.material.uniforms.tint.value.set(colour(this.role));
  }

  set(values) {
    this.attribute.array.set(values);
    this.attribute.needsUpdate = true;
  }
}

/** How many events fell into the last second. */
class Rate {
  constructor() {
    this.times = [];
  }

  add(now) {
    this.times.push(now);
    while (this.times[0] < now - 1000) this.times.shift();
  }

  value(now) {
    while (this.times.length && this.times[0] < now - 1000) this.times.shift();
    return this.times.length;
  }
}

class Playground {
  constructor(figure) {
    this.figure = figure;
    this.canvas = figure.querySelector("canvas");
    this.note = figure.querySelector("[data-note]");
    this.renderer = new WebGLRenderer({ canvas: this.canvas, antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(36, 1, 0.001, 1000);
    this.camera.up.set(0, 0, 1);
    this.orbit = new OrbitControls(this.camera, this.canvas);
    this.ray = new Raycaster();
    this.received = new Rate();
    this.keys = new Set();
    this.drag = null;
    this.sentAt = new Map();
    this.number = 0;
    this.frames = 0;
    this.clouds = [];
    figure.querySelector("[data-reset]").addEventListener("click", () => this.again());
    this.canvas.addEventListener("pointerdown", (event) => this.grab(event), { capture: true });
    this.canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) this.canvas.addEventListener(name, () => this.release());
    this.canvas.addEventListener("keydown", (event) => this.key(event, true));
    this.canvas.addEventListener("keyup", (event) => this.key(event, false));
    this.canvas.addEventListener("blur", () => this.keys.clear());
    new ResizeObserver(() => this.resize()).observe(this.canvas.parentElement);
    onSchemeChange(() => this.paint());
    requestAnimationFrame((now) => this.draw(now));
  }

  async open() {
    this.say("Connecting …");
    const answer = await fetch(this.figure.dataset.playground, { method: "POST" });
    if (!answer.ok) throw new Error(await answer.text());
    const { path } = await answer.json();
    this.socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${path}`);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = (event) => (typeof event.data === "string" ? this.begin(event.data) : this.take(event.data));
    this.socket.onclose = (event) => this.say(`The session ended: ${event.reason || ENDED[event.code] || "the connection broke"}. Press Start again.`);
  }

  /** A fresh body: in the present session, or in a new one where that has ended. */
  again() {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ type: "reset" }));
    else if (this.socket?.readyState !== WebSocket.CONNECTING) this.open().catch((error) => this.say(error.message));
  }

  begin(text) {
    const ready = JSON.parse(text);
    this.ready = ready;
    for (const cloud of this.clouds) this.scene.remove(cloud.points);
    this.body = new Cloud(ready.points, "predicted", Math.min(0.05, Math.max(0.012, 0.45 / Math.sqrt(ready.points))));
    this.markers = new Cloud(ready.controllers.length, "controllers", 0.03);
    this.handles = new Cloud(ready.grips.length, "controllers", 0.085);
    this.clouds = [this.body, this.markers, this.handles];
    for (const cloud of this.clouds) this.scene.add(cloud.points);
    this.place(new Float32Array(ready.start.flat()));
    this.places = this.grips(new Float32Array(ready.controllers.flat()));
    this.say("");
    this.figure.dataset.ready = "true";
  }

  /** Look at the body with room for its reach. */
  place(values) {
    const low = new Vector3(Infinity, Infinity, Infinity);
    const high = new Vector3(-Infinity, -Infinity, -Infinity);
    const point = new Vector3();
    for (let i = 0; i < values.length; i += 3) {
      low.min(point.fromArray(values, i));
      high.max(point);
    }
    const centre = low.clone().add(high).multiplyScalar(0.5);
    this.radius = Math.max(high.clone().sub(low).length() * 0.8, 1e-3);
    const distance = (this.radius * 1.3) / Math.sin((this.camera.fov / 2) * (Math.PI / 180));
    this.camera.position.copy(centre).addScaledVector(new Vector3(0.4, -1, 0.3).normalize(), distance);
    this.camera.near = distance / 200;
    this.camera.far = distance * 20;
    this.orbit.target.copy(centre);
    this.orbit.update();
    if (this.lines) this.scene.remove(this.lines);
    const [lines, step] = grid(low.clone().subScalar(this.radius / 3), high.clone().addScalar(this.radius / 3), null);
    this.lines = lines;
    this.scene.add(lines);
    this.figure.querySelector("[data-scale]").textContent = `grid ${+(step * 100).toPrecision(2)} cm`;
    this.paint();
    this.resize();
  }

  take(buffer) {
    const now = performance.now();
    const [, number] = new Uint32Array(buffer, 0, 2);
    const values = new Float32Array(buffer, HEAD_BYTES);
    const size = this.ready.points * 3;
    this.body.set(values.subarray(0, size));
    const controllers = values.subarray(size);
    this.markers.set(controllers);
    this.places = this.grips(controllers);
    this.handles.set(this.places.flatMap((place) => place.toArray()));
    this.received.add(now);
    this.frames += 1;
    const sent = this.sentAt.get(number);
    if (sent !== undefined) {
      this.delay = now - sent;
      for (const old of this.sentAt.keys()) if (old <= number) this.sentAt.delete(old);
    }
    const mean = [0, 0, 0];
    for (let i = 0; i < size; i += 1) mean[i % 3] += values[i] / this.ready.points;
    Object.assign(this.figure.dataset, { frames: this.frames, centre: mean.join(" "), grip: this.places[0].toArray().join(" ") });
  }

  /** Middles of the grips of all controllers. */
  grips(controllers) {
    return this.ready.grips.map((members) => {
      const middle = new Vector3();
      for (const index of members) middle.add(new Vector3().fromArray(controllers, 3 * index));
      return middle.divideScalar(members.length);
    });
  }

  pointer(event) {
    const box = this.canvas.getBoundingClientRect();
    return new Vector2(((event.clientX - box.left) / box.width) * 2 - 1, 1 - ((event.clientY - box.top) / box.height) * 2);
  }

  /** Where a grip is drawn, in shares of the canvas. */
  seen(grip) {
    const place = this.places[grip].clone().project(this.camera);
    return [(place.x + 1) / 2, (1 - place.y) / 2];
  }

  grab(event) {
    if (!this.places || event.button !== 0) return;
    const { width, height } = this.canvas.getBoundingClientRect();
    const at = this.pointer(event);
    let nearest = PICK_PIXELS;
    this.places.forEach((place, grip) => {
      const seen = place.clone().project(this.camera);
      const pixels = Math.hypot(((seen.x - at.x) * width) / 2, ((seen.y - at.y) * height) / 2);
      if (pixels < nearest) {
        nearest = pixels;
        const facing = this.camera.getWorldDirection(new Vector3());
        this.drag = { grip, plane: new Plane().setFromNormalAndCoplanarPoint(facing, place), target: place.clone() };
      }
    });
    if (!this.drag) return;
    this.orbit.enabled = false;
    this.canvas.setPointerCapture(event.pointerId);
  }

  move(event) {
    if (!this.drag) return;
    this.ray.setFromCamera(this.pointer(event), this.camera);
    this.ray.ray.intersectPlane(this.drag.plane, this.drag.target);
  }

  release() {
    this.drag = null;
    this.orbit.enabled = true;
  }

  key(event, down) {
    if (!(event.key in KEYS)) return;
    event.preventDefault();
    this.keys[down ? "add" : "delete"](event.key);
  }

  /** Send what the hand wants, once a drawn frame while it wants anything, and once more to stop. */
  steer(now) {
    if (!this.ready || this.socket?.readyState !== WebSocket.OPEN || this.socket.bufferedAmount > 4096) return;
    const velocities = this.places.map(() => new Vector3());
    if (this.drag) {
      const { grip, target } = this.drag;
      velocities[grip].copy(target).sub(this.places[grip]).multiplyScalar(GAIN_PER_S);
    }
    for (const key of this.keys) velocities[0].addScaledVector(new Vector3(...KEYS[key]), 0.25 * this.ready.speed_m_s);
    for (const velocity of velocities) velocity.clampLength(0, this.ready.speed_m_s);
    const active = Boolean(this.drag) || this.keys.size > 0;
    if (!active && !this.active) return;
    this.active = active;
    this.number += 1;
    const message = new ArrayBuffer(4 + 12 * velocities.length);
    new DataView(message).setUint32(0, this.number, true);
    new Float32Array(message, 4).set(velocities.flatMap((velocity) => velocity.toArray()));
    this.sentAt.set(this.number, now);
    if (this.sentAt.size > 500) this.sentAt.clear();
    this.socket.send(message);
  }

  draw(now) {
    requestAnimationFrame((next) => this.draw(next));
    this.steer(now);
    this.renderer.render(this.scene, this.camera);
    if (now - (this.toldAt ?? 0) < 250) return;
    this.toldAt = now;
    const rate = this.received.value(performance.now());
    this.figure.querySelector("[data-fps]").textContent = rate;
    if (this.delay !== undefined) this.figure.querySelector("[data-delay]").textContent = Math.round(this.delay);
  }

  paint() {
    for (const cloud of this.clouds) cloud.paint();
    this.lines?.material.color.set(colour("grid"));
  }

  resize() {
    const { clientWidth, clientHeight } = this.canvas.parentElement;
    if (!clientWidth || !clientHeight) return;
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    const pixels = clientHeight * this.renderer.getPixelRatio();
    const scale = pixels / (2 * Math.tan((this.camera.fov / 2) * (Math.PI / 180)));
    for (const cloud of this.clouds) cloud.material.uniforms.scale.value = scale * (this.radius ?? 1);
  }

  say(words) {
    this.note.textContent = words;
    this.note.hidden = !words;
  }
}

window.playgrounds = []; // for tests, which have no other way to know where a grip is drawn
for (const figure of document.querySelectorAll("[data-playground]")) {
  const playground = new Playground(figure);
  window.playgrounds.push(playground);
  playground.open().catch((error) => playground.say(`The session could not be opened: ${error.message}.`));
}
