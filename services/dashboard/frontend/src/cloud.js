// 3D view of a page: `<figure data-cloud="URL">` with a canvas and controls becomes a player of moving points.
// The JSON at URL: { times: [s], split: frame | null, floor: m | null, box: [corner, corner] | null (declared body),
//   layers: [{ name, label, role, count, size, shown, url, pairs? }], surface?: { url, label, role, layer } }
// A layer's URL gives float32 little-endian (frames, count, 3) [m], z up; NaN marks a point that is not visible.
// `surface` is a body, as `surfaces.py` and `tubes.py` describe it, which the points of a layer carry.
// `pairs: "name"` draws a thin line from every point of the layer to its twin in the layer of that name.

import {
  BufferAttribute, BufferGeometry, DynamicDrawUsage, LineBasicMaterial, LineSegments, Points, Vector3,
} from "three";
import { colour, onSchemeChange } from "./palette.js";
import { keepVisible, roundPoints, segments } from "./points.js";
import { bodyOf } from "./surface.js";
import { View } from "./view.js";

const DIRECTION = [0.62, -1, 0.36]; // from the middle of the scene to the camera
const MARGIN = 1.16; // of what is seen, in sizes of the scene

/** One set of moving points with its own colour, size and switch. */
class Layer {
  constructor(spec, frames) {
    this.spec = spec;
    this.frames = frames;
    this.shown = spec.shown;
    this.values = null;
    this.geometry = new BufferGeometry();
    this.attribute = new BufferAttribute(new Float32Array(spec.count * 3), 3).setUsage(DynamicDrawUsage);
    this.geometry.setAttribute("position", this.attribute);
    this.material = roundPoints(spec.size, spec.opacity ?? 1);
    this.points = new Points(this.geometry, this.material);
    this.points.frustumCulled = false;
    this.paint();
  }

  paint() {
    this.material.uniforms.tint.value.set(colour(this.spec.role));
  }

  async load() {
    if (this.values) return;
    const response = await fetch(this.spec.url);
    if (!response.ok) throw new Error(`${this.spec.label}: ${response.status}`);
    const values = new Float32Array(await response.arrayBuffer());
    const expected = this.frames * this.spec.count * 3;
    if (values.length !== expected) throw new Error(`${this.spec.label}: ${values.length} numbers, expected ${expected}`);
    this.values = values;
  }

  /** Copies the visible points of a frame to the GPU buffer. */
  show(frame) {
    this.points.visible = this.shown && this.values !== null;
    if (!this.points.visible) return;
    const size = this.spec.count * 3;
    const source = this.values.subarray(frame * size, (frame + 1) * size);
    this.geometry.setDrawRange(0, keepVisible(source, this.attribute.array));
    this.attribute.needsUpdate = true;
  }
}

/** Lines between two layers of the same count: what the prediction is wrong by. */
class Pairs {
  constructor(from, to) {
    this.from = from;
    this.to = to;
    this.attribute = new BufferAttribute(new Float32Array(from.spec.count * 6), 3).setUsage(DynamicDrawUsage);
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", this.attribute);
    this.lines = new LineSegments(geometry, new LineBasicMaterial({ transparent: true, opacity: 0.75 }));
    this.lines.frustumCulled = false;
    this.paint();
  }

  paint() {
    this.lines.material.color.set(colour("error"));
  }

  show(frame) {
    const { from, to } = this;
    this.lines.visible = from.points.visible && to.points.visible;
    if (!this.lines.visible) return;
    const size = from.spec.count * 3;
    let used = 0;
    for (let i = frame * size; i < (frame + 1) * size; i += 3) {
      if (Number.isNaN(from.values[i]) || Number.isNaN(to.values[i])) continue;
      this.attribute.array.set(from.values.subarray(i, i + 3), used);
      this.attribute.array.set(to.values.subarray(i, i + 3), used + 3);
      used += 6;
    }
    this.lines.geometry.setDrawRange(0, used / 3);
    this.attribute.needsUpdate = true;
  }
}

/** The body that a layer's points carry, with its own switch. */
class Body {
  constructor(spec, data, carriers) {
    this.spec = spec;
    this.carriers = carriers;
    this.shown = true;
    this.surface = bodyOf(data, spec.role);
  }

  static async load(spec, layers) {
    const answer = await fetch(spec.url);
    if (!answer.ok) throw new Error(`${spec.label}: ${answer.status}`);
    const body = new Body(spec, await answer.json(), layers.find((layer) => layer.spec.name === spec.layer));
    await body.load();
    return body;
  }

  async load() {
    await this.carriers.load();
  }

  paint() {
    this.surface.paint();
  }

  show(frame) {
    this.surface.mesh.visible = this.shown;
    const size = this.carriers.spec.count * 3;
    if (this.shown) this.surface.set(this.carriers.values.subarray(frame * size, (frame + 1) * size));
  }
}

/** Corners of everything that the layers show over all frames, and of the declared body. */
function bounds(layers, box) {
  const low = new Vector3(Infinity, Infinity, Infinity);
  const high = new Vector3(-Infinity, -Infinity, -Infinity);
  const point = new Vector3();
  for (const corner of box ?? []) {
    low.min(point.fromArray(corner));
    high.max(point);
  }
  for (const layer of layers) {
    if (!layer.values) continue;
    for (let i = 0; i < layer.values.length; i += 3) {
      if (Number.isNaN(layer.values[i])) continue;
      point.fromArray(layer.values, i);
      low.min(point);
      high.max(point);
    }
  }
  return low.x <= high.x ? [low, high] : [new Vector3(-0.5, -0.5, 0), new Vector3(0.5, 0.5, 1)];
}

/** The edges of the box between two corners. */
function wireframe([low, high]) {
  const corner = (index) => [0, 1, 2].map((axis) => (index & (1 << axis) ? high : low)[axis]);
  const ends = [];
  for (let index = 0; index < 8; index += 1) {
    for (const bit of [1, 2, 4]) if (!(index & bit)) ends.push(...corner(index), ...corner(index | bit));
  }
  return segments(ends);
}

class Player {
  constructor(figure, data) {
    this.figure = figure;
    this.data = data;
    this.frame = 0;
    this.playing = false;
    this.view = new View(figure.querySelector("canvas"));
    this.view.orbit.addEventListener("change", () => this.render());
    this.layers = data.layers.map((spec) => new Layer(spec, data.times.length));
    this.pairs = [];
    this.bodies = [];
    for (const layer of this.layers) this.view.scene.add(layer.points);
    for (const from of this.layers) {
      const to = this.layers.find((layer) => layer.spec.name === from.spec.pairs);
      if (to && to.spec.count === from.spec.count) this.pairs.push(new Pairs(from, to));
    }
    for (const pair of this.pairs) this.view.scene.add(pair.lines);
  }

  async start() {
    await Promise.all(this.layers.filter((layer) => layer.shown).map((layer) => layer.load()));
    if (this.data.surface) this.bodies = [await Body.load(this.data.surface, this.layers)];
    for (const body of this.bodies) this.view.scene.add(body.surface.mesh);
    this.resize();
    this.place();
    this.buildControls();
    new ResizeObserver(() => this.resize()).observe(this.view.canvas.parentElement);
    onSchemeChange(() => this.paint());
    this.seek(0);
    this.figure.dataset.ready = "true";
  }

  place() {
    const [low, high] = bounds(this.layers, this.data.box);
    const centre = low.clone().add(high).multiplyScalar(0.5);
    this.radius = Math.max(high.clone().sub(low).length() / 2, 1e-3);
    this.view.look(centre, this.radius * MARGIN, DIRECTION);
    const told = this.view.lay(low, high, this.data.floor);
    if (this.data.box) {
      this.body = wireframe(this.data.box);
      this.view.scene.add(this.body);
    }
    const label = this.figure.querySelector("[data-scale]");
    if (label) label.textContent = told;
    this.resize();
    this.paint();
  }

  paint() {
    for (const item of [this.view, ...this.layers, ...this.pairs, ...this.bodies]) item.paint();
    this.body?.material.color.set(colour("particles"));
    this.render();
  }

  buildControls() {
    const find = (name) => this.figure.querySelector(`[data-${name}]`);
    this.slider = find("slider");
    this.slider.max = this.data.times.length - 1;
    this.slider.value = 0;
    this.slider.addEventListener("input", () => {
      this.pause();
      this.seek(Number(this.slider.value));
    });
    if (this.data.split != null) {
      const share = this.data.split / Math.max(1, this.data.times.length - 1);
      this.slider.style.setProperty("--split", `${Math.min(1, share) * 100}%`);
    }
    this.button = find("play");
    this.button.addEventListener("click", () => (this.playing ? this.pause() : this.play()));
    this.speed = find("speed");
    this.clock = find("clock");
    const legend = find("legend");
    for (const layer of [...this.bodies, ...this.layers]) legend.append(this.switch(layer));
    document.addEventListener("seek", (event) => this.seek(this.frameAt(event.detail)));
  }

  switch(layer) {
    const label = document.createElement("label");
    const box = document.createElement("input");
    const dot = document.createElement("span");
    box.type = "checkbox";
    box.checked = layer.shown;
    dot.className = `dot role-${layer.spec.role}`;
    label.append(box, dot, layer.spec.label);
    box.addEventListener("change", async () => {
      layer.shown = box.checked;
      if (layer.shown) await layer.load();
      this.seek(this.frame);
    });
    return label;
  }

  frameAt(time) {
    const times = this.data.times;
    let low = 0;
    let high = times.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (times[middle] <= time) low = middle;
      else high = middle - 1;
    }
    return low;
  }

  play() {
    this.playing = true;
    this.button.textContent = "Pause";
    if (this.frame >= this.data.times.length - 1) this.seek(0);
    let last = performance.now();
    let time = this.data.times[this.frame];
    const step = (now) => {
      if (!this.playing) return;
      time += ((now - last) / 1000) * Number(this.speed.value);
      last = now;
      const frame = this.frameAt(time);
      if (frame !== this.frame) this.seek(frame);
      if (frame >= this.data.times.length - 1) this.pause();
      else requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  pause() {
    this.playing = false;
    this.button.textContent = "Play";
  }

  seek(frame) {
    const { times, split } = this.data;
    this.frame = Math.max(0, Math.min(times.length - 1, frame));
    for (const item of [...this.layers, ...this.pairs, ...this.bodies]) item.show(this.frame);
    this.slider.value = this.frame;
    this.figure.dataset.frame = this.frame;
    const part = split == null ? "" : this.frame >= split ? " · held out" : " · training";
    this.clock.textContent = `${times[this.frame].toFixed(3)} s · frame ${this.frame + 1} of ${times.length}${part}`;
    document.dispatchEvent(new CustomEvent("frame", { detail: times[this.frame] }));
    this.render();
  }

  resize() {
    if (!this.view.resize()) return;
    for (const layer of this.layers) layer.material.uniforms.scale.value = this.view.pixels * (this.radius ?? 1);
    this.render();
  }

  render() {
    this.view.render();
  }
}

async function mount(figure) {
  const note = figure.querySelector("[data-note]");
  try {
    const response = await fetch(figure.dataset.cloud);
    if (!response.ok) throw new Error(`the server answered ${response.status}`);
    const player = new Player(figure, await response.json());
    window.players.push(player);
    await player.start();
    note.remove();
  } catch (error) {
    note.textContent = `The 3D view could not be shown: ${error.message}.`;
  }
}

window.players = []; // for tests, which have no other way to see what is drawn
for (const figure of document.querySelectorAll("[data-cloud]")) mount(figure);
