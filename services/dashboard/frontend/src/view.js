// A canvas with a scene in it, seen from around: camera, background, ground. Shared by the pages' 3D views.

import {
  Color, DirectionalLight, HemisphereLight, PerspectiveCamera, Scene, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { colour } from "./palette.js";
import { grid } from "./points.js";

const HALF_ANGLE = (18 * Math.PI) / 180; // of what the camera sees, from the middle upwards

export class View {
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new WebGLRenderer({ canvas, antialias: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.scene = new Scene();
    this.scene.background = new Color();
    const sun = new DirectionalLight(0xffffff, 1.6); // surfaces are lit; points and lines have light of their own
    sun.position.set(0.4, -0.6, 1);
    this.scene.add(new HemisphereLight(0xffffff, 0x667788, 1.7), sun);
    this.camera = new PerspectiveCamera((2 * HALF_ANGLE * 180) / Math.PI, 1, 0.001, 1000);
    this.camera.up.set(0, 0, 1);
    this.orbit = new OrbitControls(this.camera, canvas);
    this.ground = null;
    this.paint();
  }

  /** How many radii from its middle a ball has to be seen from, to fit into the narrower of the camera's two angles. */
  get distance() {
    const across = Math.atan(Math.tan(HALF_ANGLE) * this.camera.aspect);
    return 1 / Math.sin(Math.min(HALF_ANGLE, across));
  }

  /** See all of a ball, from a direction. */
  look(centre, radius, direction) {
    const distance = radius * this.distance;
    this.camera.position.copy(centre).addScaledVector(new Vector3(...direction).normalize(), distance);
    this.camera.near = distance / 200;
    this.camera.far = distance * 20;
    this.camera.updateProjectionMatrix();
    this.orbit.target.copy(centre);
    this.orbit.update();
  }

  /** Draw the ground under a box; the distance between its lines in words. */
  lay(low, high, floor) {
    if (this.ground) this.scene.remove(this.ground);
    const [lines, step] = grid(low, high, floor);
    this.ground = lines;
    this.scene.add(lines);
    this.paint();
    return `grid ${step >= 1 ? `${step} m` : `${+(step * 100).toPrecision(2)} cm`}`;
  }

  paint() {
    this.scene.background.set(colour("stage"));
    this.ground?.material.color.set(colour("grid"));
  }

  /** Take the size of the canvas's frame; what was seen in full before still is. False where it has none. */
  resize() {
    const { clientWidth, clientHeight } = this.canvas.parentElement;
    if (!clientWidth || !clientHeight) return false;
    this.renderer.setSize(clientWidth, clientHeight, false);
    const before = this.distance;
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    this.camera.position.sub(this.orbit.target).multiplyScalar(this.distance / before).add(this.orbit.target);
    this.orbit.update();
    return true;
  }

  /** Pixels of a length of 1 m that is 1 m away, for the size of points. */
  get pixels() {
    return this.renderer.domElement.height / (2 * Math.tan(HALF_ANGLE));
  }

  render() {
    this.renderer.render(this.scene, this.camera);
  }
}
