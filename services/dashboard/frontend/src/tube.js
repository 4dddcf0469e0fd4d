// A rope, rod or cable as tubes along its vertices, one for the cable and one for each branch.
// `tubes.py` describes them: every place of a centre line is a weighted sum of four vertices. Rings around it are carried
// from one place to the next without a turn about the line, anew for every frame, so that nothing adds up.

import {
  BufferAttribute, BufferGeometry, DynamicDrawUsage, Mesh, MeshLambertMaterial, Vector3,
} from "three";
import { colour } from "./palette.js";

const SIDES = 12;

export class Tube {
  /** @param {object} data what `tubes.py` writes */
  constructor(data, role = "model") {
    this.data = data;
    this.role = role;
    this.ring = Array.from({ length: SIDES }, (_, side) => (2 * Math.PI * side) / SIDES).map((a) => [Math.cos(a), Math.sin(a)]);
    const rings = data.lines.reduce((sum, count) => sum + count, 0);
    const places = rings * SIDES + 2 * data.lines.length; // and the middle of either end
    this.attribute = new BufferAttribute(new Float32Array(3 * places), 3).setUsage(DynamicDrawUsage);
    this.normals = new BufferAttribute(new Float32Array(3 * places), 3).setUsage(DynamicDrawUsage);
    this.geometry = new BufferGeometry();
    this.geometry.setAttribute("position", this.attribute);
    this.geometry.setAttribute("normal", this.normals);
    this.geometry.setIndex(triangles(data.lines, rings * SIDES));
    this.mesh = new Mesh(this.geometry, new MeshLambertMaterial());
    this.mesh.frustumCulled = false;
    this.centres = Array.from({ length: rings }, () => new Vector3());
    this.paint();
  }

  paint() {
    this.mesh.material.color.set(colour(this.role));
  }

  /** Places of the graph's vertices now, x, y, z each. */
  set(values) {
    const { index, weight, lines, carriers } = this.data;
    this.centres.forEach((centre, place) => {
      centre.set(0, 0, 0);
      for (let k = place * carriers; k < (place + 1) * carriers; k += 1) {
        centre.addScaledVector(from.fromArray(values, 3 * index[k]), weight[k]);
      }
    });
    let first = 0;
    lines.forEach((count, line) => {
      this.#line(first, count, this.centres.length * SIDES + 2 * line);
      first += count;
    });
    this.attribute.needsUpdate = true;
    this.normals.needsUpdate = true;
  }

  /** The rings of one line, and the middles of its ends. */
  #line(first, count, ends) {
    for (let k = 0; k < count; k += 1) {
      const before = this.centres[first + Math.max(k - 1, 0)];
      const after = this.centres[first + Math.min(k + 1, count - 1)];
      along.subVectors(after, before).normalize();
      if (k === 0) outward.set(...(Math.abs(along.z) < 0.8 ? [0, 0, 1] : [1, 0, 0]));
      outward.addScaledVector(along, -outward.dot(along)).normalize();
      sideward.crossVectors(along, outward);
      const centre = this.centres[first + k];
      for (let side = 0; side < SIDES; side += 1) {
        const [x, y] = this.ring[side];
        const at = 3 * ((first + k) * SIDES + side);
        normal.copy(outward).multiplyScalar(x).addScaledVector(sideward, y).toArray(this.normals.array, at);
        normal.multiplyScalar(this.data.radius).add(centre).toArray(this.attribute.array, at);
      }
      if (k === 0 || k === count - 1) {
        const at = 3 * (ends + (k === 0 ? 0 : 1));
        centre.toArray(this.attribute.array, at);
        normal.copy(along).multiplyScalar(k === 0 ? -1 : 1).toArray(this.normals.array, at);
      }
    }
  }
}

const [from, along, outward, sideward, normal] = Array.from({ length: 5 }, () => new Vector3());

/** Three places each: of the rings of every line, and of the fans that close its ends. */
function triangles(lines, middles) {
  const found = [];
  let first = 0;
  lines.forEach((count, line) => {
    const corner = (ring, side) => (first + ring) * SIDES + (side % SIDES);
    for (let side = 0; side < SIDES; side += 1) {
      for (let ring = 0; ring + 1 < count; ring += 1) {
        const [a, b, c, d] = [corner(ring, side), corner(ring, side + 1), corner(ring + 1, side), corner(ring + 1, side + 1)];
        found.push(a, b, c, b, d, c);
      }
      found.push(middles + 2 * line, corner(0, side + 1), corner(0, side));
      found.push(middles + 2 * line + 1, corner(count - 1, side), corner(count - 1, side + 1));
    }
    first += count;
  });
  return found;
}
