// The calibrated twin beside the model: the engine on the same grips, drawn as a second body in the twin's colour. The
// service says how it does, { type: "twin", state, real_time, behind_s, strengths, reason }, and sends its frames.

import { Cloud } from "./points.js";
import { bodyOf } from "./surface.js";

const KEPT_TICKS = 240; // of the model, to compare a twin with that is behind
const SEEN_THROUGH = 0.62;
const IN_STEP_S = 0.1;

export class LiveTwin {
  /** @param {Function} tell sends a message; @param {Function} offer is given the strengths of the twin's effects. */
  constructor(figure, scene, tell, offer) {
    this.box = figure.querySelector('[data-show="live"]');
    this.words = figure.querySelector("[data-twin]");
    this.figure = figure;
    this.scene = scene;
    this.tell = tell;
    this.offer = offer;
    this.model = new Map();
    this.box.addEventListener("change", () => this.ask());
  }

  get wanted() {
    return this.box.checked;
  }

  /** Ask the session for the twin, or send it away. */
  ask() {
    this.tell({ type: "twin", on: this.wanted });
    if (!this.wanted) this.away();
  }

  /** A new session with so many vertices. */
  begin(count, dt) {
    this.away();
    this.count = count;
    this.dt = dt;
    this.model.clear();
    if (this.wanted) this.ask();
  }

  /** The surface that the server described, once it is there. */
  dress(surface) {
    this.described = surface;
  }

  away() {
    for (const part of [this.body?.mesh, this.cloud?.points]) if (part) this.scene.remove(part);
    this.body = null;
    this.cloud = null;
    this.latest = null;
    this.words.textContent = "";
    this.offer([]);
    delete this.figure.dataset.twinTick;
  }

  told({ state, real_time: pace, behind_s: behind, reason, strengths }) {
    if (!this.wanted) return;
    if (state === "starting") this.words.textContent = "Twin: its engine starts …";
    if (state === "running") {
      const late = behind > IN_STEP_S ? `, ${behind.toFixed(1)} s behind` : ", in step";
      this.pace = pace === null ? "" : `Twin: ${pace.toPrecision(2)} × real time${late}`;
      this.say();
      this.offer(strengths);
    }
    if (state === "stopped") this.words.textContent = `Twin stopped: ${reason}. Start again to run it anew.`;
    if (state === "refused") {
      this.away();
      this.words.textContent = `No twin beside the model: ${reason}.`;
      this.box.checked = false;
    }
  }

  /** The model's vertices at a tick. */
  follow(tick, values) {
    if (tick < this.tick) this.model.clear();
    this.tick = tick;
    if (!this.wanted) return;
    this.model.set(tick, values);
    this.model.delete(tick - KEPT_TICKS);
  }

  /** A frame of the twin. */
  take(tick, values) {
    if (!this.wanted) return;
    this.latest = values;
    if (!this.body && !this.cloud) this.enter();
    if (this.body) this.moved = true;
    else this.cloud.set(values);
    this.figure.dataset.twinTick = tick;
    const model = this.model.get(tick);
    if (!model) return;
    let sum = 0;
    for (let i = 0; i < values.length; i += 3) {
      sum += Math.hypot(values[i] - model[i], values[i + 1] - model[i + 1], values[i + 2] - model[i + 2]);
    }
    this.apart = (1000 * sum) / this.count;
    this.figure.dataset.twinApart = this.apart;
    this.say();
  }

  enter() {
    if (this.described) {
      this.body = bodyOf(this.described, "twin");
      Object.assign(this.body.mesh.material, { transparent: true, opacity: SEEN_THROUGH, depthWrite: false });
      this.scene.add(this.body.mesh);
    } else {
      this.cloud = new Cloud(this.count, "twin", 0.025, SEEN_THROUGH);
      this.scene.add(this.cloud.points);
    }
  }

  say() {
    const apart = this.apart === undefined ? "" : ` · ${this.apart.toPrecision(2)} mm from the model (mean)`;
    this.words.textContent = `${this.pace ?? "Twin"}${apart}`;
  }

  /** Before a picture is drawn. */
  draw() {
    if (this.moved && this.body) this.body.set(this.latest);
    this.moved = false;
  }

  paint() {
    this.body?.paint();
    this.cloud?.paint();
  }

  get clouds() {
    return this.cloud ? [this.cloud] : [];
  }
}
