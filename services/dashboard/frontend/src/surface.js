// A body as a surface that hangs on the graph's vertices: a solid's skin or a sheet; ropes are tubes (`tube.js`).
// A point of the surface at rest x is drawn at the weighted mean of v + R (x - X) over its carriers: X is where a vertex
// lies at rest, v where it is now, R how far its neighbourhood has turned. R is found by the iteration of Müller et al.
// (2016, "A robust method to extract the rotational part of deformations"), which begins with the last frame's turn.

import {
  BufferAttribute, BufferGeometry, DoubleSide, DynamicDrawUsage, Matrix3, Mesh, MeshLambertMaterial, Quaternion, Vector3,
} from "three";
import { colour } from "./palette.js";
import { Tube } from "./tube.js";

const ITERATIONS = 3;

/** The body that the server described: a skin or tubes. */
export function bodyOf(data, role) {
  return data.kind === "tube" ? new Tube(data, role) : new Surface(data, role);
}

class Surface {
  /** @param {object} data what `surfaces.py` writes */
  constructor(data, role = "model") {
    this.data = data;
    this.role = role;
    this.count = data.points.length / 3;
    this.vertices = data.rest.length / 3;
    this.turns = Array.from({ length: this.vertices }, () => new Quaternion());
    this.attribute = new BufferAttribute(new Float32Array(data.points), 3).setUsage(DynamicDrawUsage);
    this.geometry = new BufferGeometry();
    this.geometry.setAttribute("position", this.attribute);
    this.geometry.setIndex(data.triangles);
    this.mesh = new Mesh(this.geometry, new MeshLambertMaterial({ side: DoubleSide }));
    this.mesh.frustumCulled = false;
    this.paint();
  }

  paint() {
    this.mesh.material.color.set(colour(this.role));
  }

  /** Places of the graph's vertices now, x, y, z each. */
  set(values) {
    const { rest, neighbours, index, weight, carriers, points } = this.data;
    const each = neighbours.length / this.vertices;
    for (let i = 0; i < this.vertices; i += 1) turn(this.turns[i], i, rest, values, neighbours, each);
    const matrices = this.turns.map((one) => matrix(one));
    const out = this.attribute.array;
    for (let p = 0; p < this.count; p += 1) {
      let x = 0;
      let y = 0;
      let z = 0;
      for (let k = p * carriers; k < (p + 1) * carriers; k += 1) {
        const at = 3 * index[k];
        const m = matrices[index[k]];
        const dx = points[3 * p] - rest[at];
        const dy = points[3 * p + 1] - rest[at + 1];
        const dz = points[3 * p + 2] - rest[at + 2];
        const w = weight[k];
        x += w * (values[at] + m[0] * dx + m[1] * dy + m[2] * dz);
        y += w * (values[at + 1] + m[3] * dx + m[4] * dy + m[5] * dz);
        z += w * (values[at + 2] + m[6] * dx + m[7] * dy + m[8] * dz);
      }
      out[3 * p] = x;
      out[3 * p + 1] = y;
      out[3 * p + 2] = z;
    }
    this.attribute.needsUpdate = true;
    this.geometry.computeVertexNormals();
  }
}

const moment = new Matrix3();
const rows = [new Vector3(), new Vector3(), new Vector3()];
const columns = [new Vector3(), new Vector3(), new Vector3()];
const omega = new Vector3();
const cross = new Vector3();
const step = new Quaternion();

/** Turn a quaternion towards the rotation of vertex i's neighbourhood. */
export function turn(quaternion, i, rest, now, neighbours, each) {
  const a = moment.elements.fill(0);
  for (let n = i * each; n < (i + 1) * each; n += 1) {
    const j = neighbours[n];
    for (let c = 0; c < 3; c += 1) {
      const dx = rest[3 * j + c] - rest[3 * i + c];
      for (let r = 0; r < 3; r += 1) a[3 * c + r] += (now[3 * j + r] - now[3 * i + r]) * dx;
    }
  }
  const size = Math.hypot(...a) || 1;
  for (let c = 0; c < 3; c += 1) columns[c].set(a[3 * c], a[3 * c + 1], a[3 * c + 2]).divideScalar(size);
  for (let iteration = 0; iteration < ITERATIONS; iteration += 1) {
    omega.set(0, 0, 0);
    let along = 0;
    for (let c = 0; c < 3; c += 1) {
      rows[c].set(c === 0, c === 1, c === 2).applyQuaternion(quaternion);
      omega.add(cross.crossVectors(rows[c], columns[c]));
      along += rows[c].dot(columns[c]);
    }
    omega.divideScalar(Math.abs(along) + 1e-9);
    const angle = omega.length();
    if (angle < 1e-6) return;
    quaternion.premultiply(step.setFromAxisAngle(omega.divideScalar(angle), Math.min(angle, 1.5))).normalize();
  }
}

/** The rotation of a quaternion, row by row. */
export function matrix({ x, y, z, w }) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
    2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
    2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
  ];
}
