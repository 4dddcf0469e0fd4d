// The first pictures in space: every n-th pixel with depth in its colour, the ground that was found, the axis up. What lies
// in a drawn box has the box's colour; a click on a point hands on its pixel. `tracking.js` loads this when there is depth.

import { Box3, BufferAttribute, BufferGeometry, Color, Points, SRGBColorSpace, Vector3 } from "three";
import { colour, onSchemeChange } from "./palette.js";
import { Pointer } from "./pointer.js";
import { roundPoints, segments } from "./points.js";
import { View } from "./view.js";

const DIRECTION = [0.18, -1, 0.5]; // from the middle of what is seen to the view; a single camera looks along y
const TRIMMED = 0.12; // of the points, the farthest at each end of each axis, are not what the view is laid around
const NEAR_PX = 10; // of the pointer to a point that it means
const SHARE = 0.018; // of the radius, the size of a point
const ARM = 0.5; // of the radius, the length of the axis up
const ROLES = { object: ["accent", "in the object's box"], patch: ["warn", "on the gripper's patch"], held: ["good", "held"] };

const within = ([column, row], box) => column >= box[0] && column < box[2] && row >= box[1] && row < box[3];

export class First {
  constructor(figure, picked) {
    this.figure = figure;
    this.picked = picked;
    this.canvas = figure.querySelector("canvas");
    this.view = new View(this.canvas);
    this.boxes = {};
    this.view.orbit.addEventListener("change", () => this.render());
    this.pointer = new Pointer(this.canvas, this.view, {
      nearest: (away) => this.nearest(away),
      named: (at) => this.name(at),
      clicked: (at) => this.picked(this.cloud.cameras[at], this.cloud.pixels[at]),
    });
    new ResizeObserver(() => this.resize()).observe(this.canvas.parentElement);
    onSchemeChange(() => this.paint());
  }

  /** Draw the cloud of a preview. */
  draw(cloud) {
    this.cloud = cloud;
    this.places = cloud.places_m.map((place) => new Vector3(...place));
    const count = this.places.length;
    if (this.points) this.view.scene.remove(this.points, this.axis);
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(new Float32Array(cloud.places_m.flat()), 3));
    this.tones = new BufferAttribute(new Float32Array(count * 3), 3);
    geometry.setAttribute("tone", this.tones);
    const trimmed = this.trimmed();
    this.radius = Math.max(trimmed.getSize(new Vector3()).length() / 2, 1e-3);
    this.points = new Points(geometry, roundPoints(SHARE * this.radius, 1, true));
    this.points.frustumCulled = false;
    const foot = trimmed.getCenter(new Vector3()).setZ(cloud.ground_m ?? trimmed.min.z);
    this.axis = this.arrow(foot);
    this.view.scene.add(this.points, this.axis);
    this.view.look(trimmed.getCenter(new Vector3()), this.radius, DIRECTION);
    const lines = this.view.lay(trimmed.min, trimmed.max, cloud.ground_m);
    this.figure.querySelector("[data-scale]").textContent = `${lines} ${cloud.ground_m === null ? "below all: no ground is seen" : "on the ground"}`;
    this.dress(this.boxes);
    this.paint();
    this.resize();
    this.figure.dataset.ready = "true";
  }

  /** The box around the points without those that lie far out, such as a wall seen past the object. */
  trimmed() {
    const bounds = ["x", "y", "z"].map((axis) => {
      const sorted = this.places.map((place) => place[axis]).sort((one, other) => one - other);
      const cut = Math.floor(TRIMMED * sorted.length);
      return [sorted[cut], sorted[sorted.length - 1 - cut]];
    });
    return new Box3(new Vector3(...bounds.map(([low]) => low)), new Vector3(...bounds.map(([, high]) => high)));
  }

  /** The axis up, from its foot on the ground. */
  arrow({ x, y, z }) {
    const [top, barb] = [z + ARM * this.radius, 0.08 * ARM * this.radius];
    this.tip = new Vector3(x, y, top + barb);
    return segments([x, y, z, x, y, top, x, y, top, x - barb, y, top - 2 * barb, x, y, top, x + barb, y, top - 2 * barb]);
  }

  /** Give the points in boxes their colours, all others their own. Boxes by name and by the camera's number. */
  dress(boxes) {
    this.boxes = boxes;
    if (!this.cloud) return;
    const counts = { object: 0, patch: 0, held: 0 };
    const tone = new Color();
    const tints = Object.fromEntries(Object.entries(ROLES).map(([name, [role]]) => [name, new Color(colour(role))]));
    this.cloud.pixels.forEach((pixel, i) => {
      const inside = Object.keys(ROLES).filter((name) => {
        const box = boxes[name]?.[this.cloud.cameras[i]];
        return box && within(pixel, box);
      });
      for (const name of inside) counts[name] += 1;
      const [red, green, blue] = this.cloud.colours[i];
      if (inside.length) tone.copy(tints[inside[inside.length - 1]]);
      else tone.setRGB(red / 255, green / 255, blue / 255, SRGBColorSpace);
      this.tones.setXYZ(i, tone.r, tone.g, tone.b);
    });
    this.tones.needsUpdate = true;
    this.figure.querySelector("[data-legend]").replaceChildren(...Object.entries(ROLES).map(([name, [role, word]]) => {
      const line = document.createElement("span");
      const dot = Object.assign(document.createElement("i"), { className: "dot" });
      dot.style.background = `var(--${role})`;
      line.append(dot, `${counts[name]} ${word}`);
      line.dataset.inside = name;
      return line;
    }));
    this.render();
  }

  name(at) {
    const told = at === undefined ? "" : `${this.cloud.places_m[at].map((value) => value.toFixed(3)).join(", ")} m`;
    this.figure.querySelector("[data-named]").textContent = told;
  }

  /** Number of the point that the pointer means: the nearest to the eye of those below it; or undefined. */
  nearest(away) {
    const eye = this.view.camera.position;
    let [found, least] = [undefined, Infinity];
    (this.places ?? []).forEach((place, i) => {
      const off = away(place);
      const distance = place.distanceTo(eye) * (1 + (0.1 * off) / NEAR_PX);
      if (off < NEAR_PX && distance < least) [found, least] = [i, distance];
    });
    return found;
  }

  paint() {
    this.view.paint();
    this.axis?.material.color.set(colour("ink"));
    this.dress(this.boxes);
  }

  resize() {
    if (!this.view.resize()) return;
    if (this.points) this.points.material.uniforms.scale.value = this.view.pixels;
    this.render();
  }

  render() {
    this.view.render();
    if (!this.tip) return;
    const [x, y] = this.pointer.seenAt(this.tip);
    this.figure.querySelector("[data-up]").style.transform = `translate(${x}px, ${y}px) translate(-50%, -100%)`;
  }
}
