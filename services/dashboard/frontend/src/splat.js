// A scene's Gaussian splat on a moving body: `data-splat` answers { url, vertices }, the splat's PLY and the vertices where
// the splat was taken. Linear blend skinning as in the film (`physworld.video.moving`): a Gaussian hangs on its nearest
// vertices by one over the distance, each with its place and the turn of its neighbourhood; its scales stay. Drawn as
// ellipses from far to near (Kerbl et al. 2023), in the colour without the part that depends on the view.

import {
  DynamicDrawUsage, InstancedBufferAttribute, InstancedBufferGeometry, Float32BufferAttribute, Mesh, Quaternion,
  ShaderMaterial, Vector2, Vector3,
} from "three";
import { matrix, turn } from "./surface.js";

const CARRIERS = 8;
const NEIGHBOURS = 8;
const MOST = 20_000; // Gaussians that are drawn: the ones that cover most
const HARMONIC = 0.28209479177387814;
const NEAREST = 1e-6; // [m], in weights by one over the distance

const VERTEX = `
  attribute vec3 centre; attribute vec3 spreadA; attribute vec3 spreadB; attribute vec4 tint;
  uniform vec2 pixels;
  varying vec2 at; varying vec4 shade;
  void main() {
    vec4 view = modelViewMatrix * vec4(centre, 1.0);
    vec4 clip = projectionMatrix * view;
    at = position.xy; shade = tint;
    if (clip.w <= 0.0) { gl_Position = vec4(0.0, 0.0, 2.0, 1.0); return; }
    float f = 0.5 * projectionMatrix[1][1] * pixels.y;
    float z = -view.z;
    mat3 screen = mat3(f / z, 0.0, 0.0, 0.0, f / z, 0.0, f * view.x / (z * z), f * view.y / (z * z), 0.0);
    mat3 sigma = mat3(spreadA.x, spreadA.y, spreadA.z, spreadA.y, spreadB.x, spreadB.y, spreadA.z, spreadB.y, spreadB.z);
    mat3 m = screen * mat3(modelViewMatrix);
    mat3 flat2 = m * sigma * transpose(m);
    float a = flat2[0][0] + 0.3; float b = flat2[0][1]; float d = flat2[1][1] + 0.3;
    float middle = 0.5 * (a + d);
    float radius = length(vec2(0.5 * (a - d), b));
    vec2 along = abs(b) > 1e-6 ? normalize(vec2(b, middle + radius - a)) : (a >= d ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
    vec2 major = min(sqrt(middle + radius), 512.0) * along;
    vec2 minor = min(sqrt(max(middle - radius, 0.1)), 512.0) * vec2(-along.y, along.x);
    vec2 shift = 2.0 * (at.x * major + at.y * minor) / pixels;
    gl_Position = vec4(clip.xy / clip.w + shift, clip.z / clip.w, 1.0);
  }`;
const FRAGMENT = `
  varying vec2 at; varying vec4 shade;
  void main() {
    float far = dot(at, at);
    if (far > 9.0) discard;
    gl_FragColor = vec4(shade.rgb, shade.a * exp(-0.5 * far));
  }`;

export class Splat {
  /** The splat that the server knows of; null where there is none, or none that can be read here. */
  static async load(url) {
    const answer = await fetch(url);
    const data = answer.ok ? await answer.json() : null;
    if (!data) return null;
    const file = await fetch(data.url);
    if (!file.ok) return null;
    return new Splat(readPly(await file.arrayBuffer()), Float32Array.from(data.vertices));
  }

  constructor(gaussians, rest) {
    this.rest = rest;
    this.count = gaussians.length;
    this.vertices = rest.length / 3;
    this.gaussians = gaussians;
    this.turns = Array.from({ length: this.vertices }, () => new Quaternion());
    this.each = Math.min(NEIGHBOURS, this.vertices - 1);
    this.neighbours = Array.from({ length: this.vertices }, (_, i) => nearest(rest, rest, i, this.each + 1).slice(1).map(([j]) => j)).flat();
    this.bind();
    this.placed = { centre: new Float32Array(3 * this.count), spread: new Float32Array(6 * this.count) };
    this.build();
    this.set(rest);
  }

  /** Vertices and weights that carry each Gaussian. */
  bind() {
    const centres = Float32Array.from(this.gaussians.flatMap((one) => one.centre));
    const carriers = Math.min(CARRIERS, this.vertices);
    this.carriers = this.gaussians.map((_, g) => {
      const found = nearest(this.rest, centres, g, carriers);
      const near = found.map(([, distance]) => 1 / Math.max(distance, NEAREST));
      const sum = near.reduce((total, one) => total + one, 0);
      return found.map(([j], k) => [j, near[k] / sum]);
    });
  }

  build() {
    const geometry = new InstancedBufferGeometry();
    geometry.setAttribute("position", new Float32BufferAttribute([-3, -3, 0, 3, -3, 0, 3, 3, 0, -3, 3, 0], 3));
    geometry.setIndex([0, 1, 2, 0, 2, 3]);
    geometry.instanceCount = this.count;
    const each = { centre: 3, spreadA: 3, spreadB: 3, tint: 4 };
    for (const [name, size] of Object.entries(each)) {
      const attribute = new InstancedBufferAttribute(new Float32Array(size * this.count), size).setUsage(DynamicDrawUsage);
      geometry.setAttribute(name, attribute);
    }
    this.geometry = geometry;
    this.material = new ShaderMaterial({
      vertexShader: VERTEX, fragmentShader: FRAGMENT, transparent: true, depthWrite: false,
      uniforms: { pixels: { value: new Vector2(1, 1) } },
    });
    this.mesh = new Mesh(geometry, this.material);
    this.mesh.frustumCulled = false;
    this.mesh.renderOrder = 1;
  }

  /** Places of the graph's vertices now, x, y, z each. */
  set(values) {
    for (let i = 0; i < this.vertices; i += 1) turn(this.turns[i], i, this.rest, values, this.neighbours, this.each);
    const matrices = this.turns.map((one) => matrix(one));
    const { centre, spread } = this.placed;
    this.gaussians.forEach((one, g) => {
      const place = [0, 0, 0];
      blended.set(0, 0, 0, 0);
      const first = this.turns[this.carriers[g][0][0]];
      for (const [j, w] of this.carriers[g]) {
        const m = matrices[j];
        const d = [0, 1, 2].map((axis) => one.centre[axis] - this.rest[3 * j + axis]);
        for (let axis = 0; axis < 3; axis += 1) {
          place[axis] += w * (values[3 * j + axis] + m[3 * axis] * d[0] + m[3 * axis + 1] * d[1] + m[3 * axis + 2] * d[2]);
        }
        const q = this.turns[j];
        const s = first.dot(q) < 0 ? -w : w;
        blended.set(blended.x + s * q.x, blended.y + s * q.y, blended.z + s * q.z, blended.w + s * q.w);
      }
      centre.set(place, 3 * g);
      spread.set(covariance(matrix(blended.normalize().multiply(one.turn)), one.scale), 6 * g);
    });
    this.moved = true;
  }

  /** Before a picture is drawn: what is far first. */
  sort(camera, canvas) {
    this.material.uniforms.pixels.value.set(canvas.width, canvas.height);
    camera.getWorldDirection(direction);
    const { centre, spread } = this.placed;
    const depth = new Float32Array(this.count);
    for (let g = 0; g < this.count; g += 1) {
      depth[g] = centre[3 * g] * direction.x + centre[3 * g + 1] * direction.y + centre[3 * g + 2] * direction.z;
    }
    const order = Uint32Array.from(depth.keys()).sort((a, b) => depth[b] - depth[a]);
    const { centre: into, spreadA, spreadB, tint } = this.geometry.attributes;
    order.forEach((g, place) => {
      into.array.set(centre.subarray(3 * g, 3 * g + 3), 3 * place);
      spreadA.array.set(spread.subarray(6 * g, 6 * g + 3), 3 * place);
      spreadB.array.set(spread.subarray(6 * g + 3, 6 * g + 6), 3 * place);
      tint.array.set(this.gaussians[g].tint, 4 * place);
    });
    for (const attribute of [into, spreadA, spreadB, tint]) attribute.needsUpdate = true;
  }
}

const blended = new Quaternion();
const direction = new Vector3();

/** The upper half of R S S Rᵀ: xx, xy, xz, yy, yz, zz. */
function covariance(m, scale) {
  const [a, b, c] = scale.map((one) => one * one);
  const entry = (i, j) => m[3 * i] * m[3 * j] * a + m[3 * i + 1] * m[3 * j + 1] * b + m[3 * i + 2] * m[3 * j + 2] * c;
  return [entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2)];
}

/** The `count` points nearest to point i of others, each with its distance, the nearest first. */
function nearest(points, others, i, count) {
  const found = [];
  for (let j = 0; j < points.length / 3; j += 1) {
    const distance = Math.hypot(points[3 * j] - others[3 * i], points[3 * j + 1] - others[3 * i + 1], points[3 * j + 2] - others[3 * i + 2]);
    if (found.length < count || distance < found.at(-1)[1]) {
      let place = found.length;
      while (place > 0 && found[place - 1][1] > distance) place -= 1;
      found.splice(place, 0, [j, distance]);
      if (found.length > count) found.pop();
    }
  }
  return found;
}

const SIZES = { float: 4, double: 8, uchar: 1, char: 1, short: 2, ushort: 2, int: 4, uint: 4 };

/** The Gaussians of a binary little-endian PLY, those that cover most. Throws where it is none. */
export function readPly(buffer) {
  const head = new TextDecoder("ascii").decode(buffer.slice(0, 65536));
  const end = head.indexOf("end_header\n");
  if (!head.startsWith("ply") || end < 0 || !head.includes("format binary_little_endian")) throw new Error("the splat is no binary PLY");
  const lines = head.slice(0, end).split("\n");
  const count = Number(lines.find((line) => line.startsWith("element vertex")).split(" ")[2]);
  let row = 0;
  const places = {};
  for (const [, type, name] of lines.filter((line) => line.startsWith("property")).map((line) => line.trim().split(" "))) {
    places[name] = [row, type];
    row += SIZES[type];
  }
  const view = new DataView(buffer, end + "end_header\n".length);
  const value = (g, name) => {
    const [offset, type] = places[name];
    return type === "double" ? view.getFloat64(g * row + offset, true) : view.getFloat32(g * row + offset, true);
  };
  const some = (g, stem, names) => names.map((name) => value(g, `${stem}${name}`));
  const all = Array.from({ length: count }, (_, g) => {
    const [w, x, y, z] = some(g, "rot_", [0, 1, 2, 3]);
    const opacity = 1 / (1 + Math.exp(-value(g, "opacity")));
    return {
      centre: some(g, "", ["x", "y", "z"]),
      scale: some(g, "scale_", [0, 1, 2]).map(Math.exp),
      turn: new Quaternion(x, y, z, w).normalize(),
      tint: [...some(g, "f_dc_", [0, 1, 2]).map((one) => Math.min(1, Math.max(0, 0.5 + HARMONIC * one))), opacity],
    };
  });
  if (all.length <= MOST) return all;
  const cover = ({ scale, tint }) => tint[3] * Math.max(scale[0] * scale[1], scale[1] * scale[2], scale[0] * scale[2]);
  return all.sort((a, b) => cover(b) - cover(a)).slice(0, MOST);
}
