// The markers of a table in 3D, as an import would take them. A click on one takes it for something else, a click on an
// axis of the file's frame lets that axis point up; `changed` hears of both. `upload.js` loads this when there is a table.

import { Box3, Vector3 } from "three";
import { onSchemeChange } from "./palette.js";
import { Pointer } from "./pointer.js";
import { Cloud } from "./points.js";
import { View } from "./view.js";

const DIRECTION = [0.62, -1, 0.36]; // from the middle of the markers to the camera
const MARGIN = 1.16; // of what is seen, in sizes of what is there
const NEAR_PX = 16; // of the pointer to a marker that it means
const ARM_PX = 64; // of the frame's axes
const KINDS = [["body", "measured", "body"], ["gripper", "controllers", "gripper"], ["", "particles", "left out"]];

/** What a marker is drawn as; one that is both is held. */
const kindOf = ({ roles }) => (roles.includes("gripper") ? "gripper" : roles[0] ?? "");

/** What a click makes of a marker: body, gripper, left out, in turn; a rigid body's pose is never on the body. */
function after(marker) {
  const kind = kindOf(marker);
  if (kind === "body" || (marker.rigid && !kind)) return ["gripper"];
  return kind ? [] : ["body"];
}

/** A name as the form takes it, between commas; one with a comma by a pattern. */
const written = (name) => (name.includes(",") ? name.replace(/[,[\]]/g, "?") : name);

export class Markers {
  constructor(figure, changed) {
    this.figure = figure;
    this.changed = changed;
    this.markers = [];
    this.clouds = [];
    this.canvas = figure.querySelector("canvas");
    this.view = new View(this.canvas);
    this.arms = figure.querySelector("[data-axes] path");
    this.buttons = [...figure.querySelectorAll("[data-axis]")];
    for (const button of this.buttons) button.addEventListener("click", () => changed({ up: button.dataset.axis }));
    this.view.orbit.addEventListener("change", () => this.render());
    this.pointer = new Pointer(this.canvas, this.view, {
      nearest: (away) => this.nearest(away),
      named: (marker) => this.name(marker),
      clicked: (marker) => this.click(marker),
    });
    new ResizeObserver(() => this.resize()).observe(this.canvas.parentElement);
    onSchemeChange(() => this.paint());
  }

  /** Draw what a preview found. */
  draw({ markers, axes, guesses }) {
    this.markers = markers.map((marker) => ({ ...marker, place: new Vector3(...marker.place_m) }));
    this.axes = axes.map((axis) => new Vector3(...axis));
    const up = guesses.find((guess) => guess.option === "up").value;
    for (const button of this.buttons) button.setAttribute("aria-pressed", button.dataset.axis === up);
    const box = new Box3().setFromPoints(this.markers.map(({ place }) => place));
    if (!this.box?.equals(box)) this.place(box);
    this.dress();
    this.figure.dataset.ready = "true";
  }

  place(box) {
    this.box = box;
    this.radius = Math.max(box.getSize(new Vector3()).length() / 2, 1e-3);
    this.view.look(box.getCenter(new Vector3()), this.radius * MARGIN, DIRECTION);
    this.figure.querySelector("[data-scale]").textContent = this.view.lay(box.min, box.max, null);
  }

  /** Give every marker the colour of what it is taken for. */
  dress() {
    for (const cloud of this.clouds) {
      this.view.scene.remove(cloud.points);
      cloud.points.geometry.dispose();
      cloud.material.dispose();
    }
    const size = Math.min(0.065, Math.max(0.012, 0.3 / Math.sqrt(this.markers.length)));
    const told = [];
    this.clouds = KINDS.map(([kind, role, word]) => {
      const members = this.markers.filter((marker) => kindOf(marker) === kind);
      const cloud = new Cloud(members.length, role, size);
      cloud.set(members.flatMap((marker) => marker.place_m));
      this.view.scene.add(cloud.points);
      const line = document.createElement("span");
      line.append(Object.assign(document.createElement("i"), { className: `dot role-${role}` }), `${word} ${members.length}`);
      told.push(line);
      return cloud;
    });
    this.figure.querySelector("[data-legend]").replaceChildren(...told);
    this.resize();
    this.render();
  }

  click(marker) {
    marker.roles = after(marker);
    this.dress();
    this.name(marker);
    const names = (role) => this.markers.filter(({ roles }) => roles.includes(role)).map(({ name }) => written(name)).join(", ");
    this.changed({ controllers: names("gripper") || "none", markers: names("body") });
  }

  name(marker) {
    const told = marker ? `${marker.name}: ${marker.roles.join(" and ") || "left out"}` : "";
    this.figure.querySelector("[data-named]").textContent = told;
  }

  /** The marker that the pointer means, or undefined. */
  nearest(away) {
    const near = this.markers.map((marker) => [away(marker.place), marker]).filter(([distance]) => distance < NEAR_PX);
    return near.sort(([one], [other]) => one - other)[0]?.[1];
  }

  paint() {
    for (const item of [this.view, ...this.clouds]) item.paint();
    this.render();
  }

  resize() {
    if (!this.view.resize()) return;
    for (const cloud of this.clouds) cloud.material.uniforms.scale.value = this.view.pixels * (this.radius ?? 1);
    this.render();
  }

  /** The view, and the file's frame turned as it is. */
  render() {
    this.view.render();
    if (!this.axes) return;
    const turn = this.view.camera.quaternion.clone().invert();
    const ends = {};
    this.axes.forEach((axis, i) => {
      ends["xyz"[i]] = axis.clone().applyQuaternion(turn).multiplyScalar(ARM_PX);
      ends[`-${"xyz"[i]}`] = ends["xyz"[i]].clone().negate();
    });
    for (const button of this.buttons) {
      const { x, y, z } = ends[button.dataset.axis];
      button.style.transform = `translate(${x}px, ${-y}px)`;
      button.style.zIndex = Math.round(z) + ARM_PX;
    }
    this.arms.setAttribute("d", Object.values(ends).map(({ x, y }) => `M0 0L${x.toFixed(1)} ${(-y).toFixed(1)}`).join(""));
  }
}
