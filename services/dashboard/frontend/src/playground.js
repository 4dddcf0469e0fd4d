// The playground: `<figure data-playground="URL">` opens a live session of a world model and draws its answers.
// POST to URL gives { path }, the WebSocket's address with a ticket. The first message is JSON: { dt_s, points,
//   controllers [[x, y, z]], grips [[index]], holding [[grip]], speed_m_s, reach_m, factors [name], strengths [{ name, label, unit,
//   low, high, value }], start [[x, y, z]] }. Then binary frames, little-endian:
//   uint32 tick, uint32 number of the last control, float32 time, uint32 flags, float32 points and controllers [m]; those
//   with flag 2 are of the twin (`twin.js`), of which texts { type: "twin" } tell.
// A control is uint32 number, float32 velocities (grips, 3) [m/s]: a dragged grip is steered towards the pointer.

import { Plane, Raycaster, Vector2, Vector3 } from "three";
import { onSchemeChange } from "./palette.js";
import { Factors } from "./factors.js";
import { Ghost } from "./ghost.js";
import { Grips } from "./grips.js";
import { Cloud } from "./points.js";
import { Recorder } from "./record.js";
import { Splat } from "./splat.js";
import { bodyOf } from "./surface.js";
import { LiveTwin } from "./twin.js";
import { View } from "./view.js";

const HEAD_BYTES = 16;
const SET_BACK = 1; // flags of frames
const OF_TWIN = 2;
const PICK_PIXELS = { mouse: 28, pen: 32, touch: 48 };
const SETTLE_S = 0.5; // after the end of the recorded motion, to arrive
const STILL = 1e-3; // of the body's size: a grip that is so near its target stays where it is
const GAIN_PER_S = 12; // how fast a grip follows the pointer: it covers the gap in about a tenth of a second
const DIRECTION = [0.4, -1, 0.3]; // from the middle of the body to the camera
const KEYS = {
  ArrowLeft: [-1, 0, 0], ArrowRight: [1, 0, 0], ArrowUp: [0, 1, 0], ArrowDown: [0, -1, 0], PageUp: [0, 0, 1],
  PageDown: [0, 0, -1],
};
const ENDED = {
  1007: "the session refused a message", 1008: "the session was refused", 1013: "all live sessions are taken",
  4408: "nothing was moved for a while", 4409: "the connection was too slow",
};

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
    this.view = new View(this.canvas);
    this.recorder = new Recorder(this.canvas);
    this.ray = new Raycaster();
    this.drawn = new Rate();
    this.chosen = 0;
    this.keys = new Set();
    this.drag = null;
    this.sentAt = new Map();
    this.number = 0;
    this.frames = 0;
    this.clouds = [];
    this.factors = new Factors(figure.querySelector("[data-factors]"), (factors, strengths) => this.tell({ type: "factors", factors, strengths }));
    this.holding = new Grips(figure.querySelector("[data-grips]"), (open) => this.tell({ type: "open", grips: open }));
    const offer = (strengths) => this.factors.beside(strengths);
    this.twin = new LiveTwin(figure, this.view.scene, (message) => this.ask(message), offer);
    const pressed = (name, then) => figure.querySelector(`[data-${name}]`).addEventListener("click", then);
    pressed("reset", () => this.again());
    pressed("view", () => this.look());
    pressed("replay", () => this.replay());
    pressed("record", () => this.record());
    for (const box of figure.querySelectorAll("[data-show]")) box.addEventListener("change", () => this.dress());
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
    this.socket.onmessage = (event) => (typeof event.data === "string" ? this.hear(JSON.parse(event.data)) : this.take(event.data));
    this.socket.onclose = (event) => this.say(`The session ended: ${event.reason || ENDED[event.code] || "the connection broke"}. Press Start again.`);
  }

  /** A text of the service. */
  hear(message) {
    if (message.type === "twin") this.twin.told(message);
    else this.begin(message);
  }

  /** The body's surface, its splat and the recording, where there are any; the session does not wait for them. */
  async accompany() {
    const load = async (url) => { const answer = await fetch(url); return answer.ok ? answer.json() : null; };
    const { surface: skin, ghost: recording, splat: look } = this.figure.dataset;
    const [surface, ghost, splat] = await Promise.all([load(skin), Ghost.load(recording), Splat.load(look)]);
    this.ghost = ghost;
    this.splat = splat;
    if (splat) this.view.scene.add(splat.mesh);
    this.twin.dress(surface);
    if (surface) {
      this.surface = bodyOf(surface);
      this.view.scene.add(this.surface.mesh);
    }
    const offered = { surface: Boolean(surface), splat: Boolean(splat), measured: ghost?.has("measured"), twin: ghost?.has("twin") };
    for (const [name, there] of Object.entries(offered)) this.figure.querySelector(`[data-for="${name}"]`).hidden = !there;
    this.figure.querySelector("[data-replay]").hidden = !ghost?.has("controllers");
    await this.dress();
    this.figure.dataset.accompanied = "true";
  }

  /** Draw what the boxes say. */
  async dress() {
    const wanted = (name) => this.figure.querySelector(`[data-show="${name}"]`).checked;
    if (this.splat) this.splat.mesh.visible = wanted("splat") && Boolean(this.body);
    if (this.surface) this.surface.mesh.visible = wanted("surface") && Boolean(this.body) && !this.splat?.mesh.visible;
    if (this.body) this.body.points.visible = !this.surface?.mesh.visible && !this.splat?.mesh.visible;
    if (this.ghost) {
      await Promise.all(["measured", "twin"].map((name) => this.ghost.show(name, this.view.scene, wanted(name))));
      this.ghost.stale = true;
      this.ghost.at(this.ghost.start);
    }
    if (this.latest) for (const part of [this.surface, this.splat]) part?.set(this.latest);
    this.resize();
  }

  /** Move the grips as they moved in the recording, from its start. */
  async replay() {
    await this.ghost.values("controllers");
    this.again();
    this.replayed = performance.now();
  }

  /** Begin to record, or end it and offer what was recorded. */
  async record() {
    const button = this.figure.querySelector("[data-record]");
    const links = ["film", "arrays"].map((name) => this.figure.querySelector(`[data-${name}]`));
    if (!this.recorder.running) {
      for (const link of links) link.hidden = true;
      this.recorder.start();
    } else {
      const files = await this.recorder.stop(this.ready.points, this.ready.controllers.length);
      for (const [name, url] of Object.entries(files)) {
        const link = this.figure.querySelector(`[data-${name}]`);
        Object.assign(link, { href: url, download: `${this.figure.dataset.name}.${name === "film" ? this.recorder.ending : "npz"}`, hidden: false });
      }
    }
    button.textContent = this.recorder.running ? "Stop recording" : "Record";
    button.setAttribute("aria-pressed", this.recorder.running);
  }

  /** A fresh body: in the present session, or in a new one where that has ended. */
  again() {
    this.replayed = null;
    this.holding.reset();
    if (this.tell({ type: "reset" })) return;
    if (this.socket?.readyState !== WebSocket.CONNECTING) this.open().catch((error) => this.say(error.message));
  }

  /** Ask for the twin, with which both begin again, or send it away. */
  ask(message) {
    if (message.on) this.holding.reset();
    this.tell(message);
  }

  /** Send a message as text; false where there is no session to tell. */
  tell(message) {
    if (this.socket?.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }

  begin(ready) {
    this.ready = ready;
    for (const cloud of this.clouds) this.view.scene.remove(cloud.points);
    this.body = new Cloud(ready.points, "model", Math.min(0.05, Math.max(0.012, 0.45 / Math.sqrt(ready.points))));
    this.markers = new Cloud(ready.controllers.length, "controllers", 0.03);
    this.handles = new Cloud(ready.grips.length, "controllers", 0.085);
    this.clouds = [this.body, this.markers, this.handles];
    for (const cloud of [this.markers, this.handles]) { // a grip may lie inside the body
      cloud.material.depthTest = false;
      cloud.material.transparent = true; // drawn after a twin that is seen through, and after a splat
      cloud.points.renderOrder = 2;
    }
    for (const cloud of this.clouds) this.view.scene.add(cloud.points);
    this.latest = new Float32Array(ready.start.flat());
    this.place(this.latest);
    this.dress();
    this.places = this.grips(new Float32Array(ready.controllers.flat()));
    this.factors.offer(ready.factors, ready.strengths ?? []);
    this.holding.offer(ready.grips.length, ready.holding ?? []);
    this.twin.begin(ready.points, ready.dt_s);
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
    this.centre = low.clone().add(high).multiplyScalar(0.5);
    this.radius = Math.max(high.clone().sub(low).length() * 0.8, 1e-3);
    this.look();
    const around = this.radius / 3;
    const told = this.view.lay(low.clone().subScalar(around), high.clone().addScalar(around), null);
    this.figure.querySelector("[data-scale]").textContent = told;
    this.paint();
    this.resize();
  }

  /** The camera as it was at the beginning. */
  look() {
    if (this.centre) this.view.look(this.centre, this.radius * 1.3, DIRECTION);
  }

  take(buffer) {
    const now = performance.now();
    const [tick, number, , flags] = new Uint32Array(buffer, 0, 4);
    const values = new Float32Array(buffer, HEAD_BYTES);
    const size = this.ready.points * 3;
    if (flags & OF_TWIN) {
      this.twin.take(tick, values.subarray(0, size));
      return;
    }
    if (flags & SET_BACK) this.holding.reset();
    const heard = number !== this.acknowledged; // for the first time: later frames of the same control tell no delay
    this.acknowledged = number;
    this.twin.follow(tick, values.subarray(0, size));
    this.latest = values.subarray(0, size);
    if (this.surface?.mesh.visible || this.splat?.mesh.visible) this.moved = true;
    else this.body.set(this.latest);
    this.recorder.take(new Float32Array(buffer, 8, 1)[0], values);
    const controllers = values.subarray(size);
    this.markers.set(controllers);
    this.places = this.grips(controllers);
    this.handles.set(this.places.flatMap((place) => place.toArray()));
    this.frames += 1;
    const sent = this.sentAt.get(number);
    if (heard && sent !== undefined) {
      this.delay = now - sent.at;
      for (const old of this.sentAt.keys()) if (old < number) this.sentAt.delete(old);
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
    const place = this.places[grip].clone().project(this.view.camera);
    return [(place.x + 1) / 2, (1 - place.y) / 2];
  }

  grab(event) {
    if (!this.places || event.button !== 0) return;
    const { width, height } = this.canvas.getBoundingClientRect();
    const at = this.pointer(event);
    let nearest = PICK_PIXELS[event.pointerType] ?? PICK_PIXELS.mouse;
    this.places.forEach((place, grip) => {
      const seen = place.clone().project(this.view.camera);
      const pixels = Math.hypot(((seen.x - at.x) * width) / 2, ((seen.y - at.y) * height) / 2);
      if (pixels < nearest) {
        nearest = pixels;
        const facing = this.view.camera.getWorldDirection(new Vector3());
        this.drag = { grip, plane: new Plane().setFromNormalAndCoplanarPoint(facing, place), target: place.clone() };
      }
    });
    if (!this.drag) return;
    this.replayed = null;
    this.chosen = this.drag.grip;
    this.ray.setFromCamera(at, this.view.camera); // the hand holds the grip where it took it
    const held = this.ray.ray.intersectPlane(this.drag.plane, new Vector3());
    this.drag.offset = held ? this.drag.target.clone().sub(held) : new Vector3();
    this.view.orbit.enabled = false;
    this.canvas.setPointerCapture(event.pointerId);
  }

  move(event) {
    if (!this.drag) return;
    this.ray.setFromCamera(this.pointer(event), this.view.camera);
    const held = this.ray.ray.intersectPlane(this.drag.plane, new Vector3());
    if (held) this.drag.target.copy(held).add(this.drag.offset);
  }

  release() {
    this.drag = null;
    this.view.orbit.enabled = true;
  }

  key(event, down) {
    if (down && event.key === "Home") this.look();
    if (down && event.key >= "1" && this.places?.[event.key - 1]) this.chosen = event.key - 1;
    if (!(event.key in KEYS)) return;
    this.replayed = null;
    event.preventDefault();
    this.keys[down ? "add" : "delete"](event.key);
  }

  /** Send what the hand wants, once a drawn frame while it wants anything, and once more to stop. */
  steer(now) {
    if (!this.ready || this.socket?.readyState !== WebSocket.OPEN || this.socket.bufferedAmount > 4096) return;
    const velocities = this.places.map(() => new Vector3());
    const time = this.replayed === null || this.replayed === undefined ? null : this.ghost.start + (now - this.replayed) / 1000;
    if (this.drag) velocities[this.drag.grip].copy(this.towards(this.drag.grip, this.drag.target, now));
    else if (time !== null) {
      this.ghost.at(time);
      this.ready.grips.forEach((members, grip) => {
        velocities[grip].copy(this.towards(grip, this.ghost.grip(members, time + 1 / GAIN_PER_S, new Vector3()), now));
      });
      if (time > this.ghost.end + SETTLE_S) this.replayed = null;
    }
    for (const key of this.keys) velocities[this.chosen].addScaledVector(new Vector3(...KEYS[key]), 0.25 * this.ready.speed_m_s);
    for (const velocity of velocities) velocity.clampLength(0, this.ready.speed_m_s);
    const active = Boolean(this.drag) || time !== null || this.keys.size > 0;
    if (!active && !this.active) return;
    this.active = active;
    this.number += 1;
    const message = new ArrayBuffer(4 + 12 * velocities.length);
    new DataView(message).setUint32(0, this.number, true);
    new Float32Array(message, 4).set(velocities.flatMap((velocity) => velocity.toArray()));
    this.sentAt.set(this.number, { at: now, velocities });
    if (this.sentAt.size > 500) this.sentAt.clear();
    this.socket.send(message);
  }

  /** The velocity that brings a grip to a target: from where it will be once what was sent has arrived. */
  towards(grip, target, now) {
    const expected = this.places[grip].clone();
    const sent = [...this.sentAt].filter(([number]) => number >= (this.acknowledged ?? 0));
    sent.forEach(([number, { at, velocities }], i) => {
      if (number > this.acknowledged) expected.addScaledVector(velocities[grip], ((sent[i + 1]?.[1].at ?? now) - at) / 1000);
    });
    const gap = target.clone().sub(expected);
    return gap.length() < STILL * this.radius ? gap.set(0, 0, 0) : gap.multiplyScalar(GAIN_PER_S);
  }

  draw(now) {
    requestAnimationFrame((next) => this.draw(next));
    this.steer(now);
    for (const part of [this.surface, this.splat]) if (this.moved && part?.mesh.visible) part.set(this.latest);
    this.moved = false;
    this.twin.draw();
    if (this.splat?.mesh.visible) this.splat.sort(this.view.camera, this.canvas);
    this.view.render();
    this.drawn.add(performance.now());
    if (now - (this.toldAt ?? 0) < 250) return;
    this.toldAt = now;
    const rate = this.drawn.value(performance.now());
    this.figure.querySelector("[data-fps]").textContent = rate;
    if (this.delay !== undefined) this.figure.querySelector("[data-delay]").textContent = Math.round(this.delay);
  }

  paint() {
    for (const cloud of [...this.clouds, ...(this.ghost?.clouds ?? [])]) cloud.paint();
    this.surface?.paint();
    this.twin.paint();
    this.view.paint();
  }

  resize() {
    if (!this.view.resize()) return;
    const scale = this.view.pixels * (this.radius ?? 1);
    for (const cloud of [...this.clouds, ...this.twin.clouds, ...(this.ghost?.clouds ?? [])]) cloud.material.uniforms.scale.value = scale;
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
  playground.accompany().catch((error) => playground.say(`What belongs to the model could not be loaded: ${error.message}.`));
  playground.open().catch((error) => playground.say(`The session could not be opened: ${error.message}.`));
}
