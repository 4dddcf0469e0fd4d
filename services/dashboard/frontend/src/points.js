// What the 3D views share: round points, the ground's grid, line segments.

import {
  BufferAttribute, BufferGeometry, Color, CustomBlending, DynamicDrawUsage, LineBasicMaterial, LineSegments,
  NormalBlending, OneFactor, Points, ShaderMaterial, ZeroFactor,
} from "three";
import { colour } from "./palette.js";

const VERTEX = `
  uniform float size; uniform float scale;
  #ifdef TONED
    attribute vec3 tone;
    varying vec3 tint;
  #endif
  void main() {
    #ifdef TONED
      tint = tone;
    #endif
    vec4 view = modelViewMatrix * vec4(position, 1.0);
    gl_Position = projectionMatrix * view;
    gl_PointSize = clamp(size * scale / -view.z, 2.0, 40.0);
  }`;
const FRAGMENT = `
  #ifdef TONED
    varying vec3 tint;
  #else
    uniform vec3 tint;
  #endif
  uniform float opacity;
  void main() {
    vec2 p = gl_PointCoord * 2.0 - 1.0;
    float r = dot(p, p);
    float edge = 1.0 - smoothstep(1.0 - min(0.5, 2.0 * fwidth(r)), 1.0, r);
    if (edge <= 0.0) discard;
    float light = 0.62 + 0.38 * sqrt(1.0 - r) - 0.18 * (p.x + p.y) * 0.5;
    gl_FragColor = vec4(tint * light, opacity * edge);
    #include <colorspace_fragment>
  }`;

/**
 * The material of round points. The alpha of an opaque point's edge only says how many samples of a pixel the point
 * covers: it is not written into the picture, where it would mix the page's background into the point. `toned` points have
 * a colour each, the attribute `tone`.
 */
export function roundPoints(size, opacity, toned = false) {
  const opaque = opacity === 1;
  return new ShaderMaterial({
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT,
    defines: toned ? { TONED: "" } : {},
    uniforms: { size: { value: size }, scale: { value: 1 }, tint: { value: new Color() }, opacity: { value: opacity } },
    transparent: !opaque,
    depthWrite: opaque,
    alphaToCoverage: opaque,
    blending: opaque ? CustomBlending : NormalBlending,
    blendSrc: OneFactor,
    blendDst: ZeroFactor,
    blendSrcAlpha: ZeroFactor,
    blendDstAlpha: OneFactor,
  });
}

/** A round number of metres near a tenth of the extent: 1, 2 or 5 times a power of ten. */
function gridStep(extent) {
  const rough = extent / 8;
  const power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= rough);
}

/** Lines on the floor under a box, and the distance between them [m]. */
export function grid(low, high, floor) {
  const extent = Math.max(high.x - low.x, high.y - low.y, (high.z - low.z) * 0.6, 0.01) * 1.1;
  const step = gridStep(extent);
  const half = Math.ceil(extent / 2 / step) * step;
  const centre = [low.x + high.x, low.y + high.y].map((sum) => Math.round(sum / 2 / step) * step);
  const z = floor ?? low.z - 0.02 * extent;
  const corners = [];
  for (let offset = -half; offset <= half + step / 2; offset += step) {
    corners.push(centre[0] + offset, centre[1] - half, z, centre[0] + offset, centre[1] + half, z);
    corners.push(centre[0] - half, centre[1] + offset, z, centre[0] + half, centre[1] + offset, z);
  }
  return [segments(corners), step];
}

/** Lines between pairs of points, x, y, z each. */
export function segments(ends) {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(ends), 3));
  return new LineSegments(geometry, new LineBasicMaterial());
}

/** Copies the points of a frame that are visible, those without NaN, into a buffer; how many they are. */
export function keepVisible(values, target) {
  let used = 0;
  for (let i = 0; i < values.length; i += 3) {
    if (Number.isNaN(values[i])) continue;
    target[used] = values[i];
    target[used + 1] = values[i + 1];
    target[used + 2] = values[i + 2];
    used += 3;
  }
  return used / 3;
}

/** Round points of one colour, whose places are set from a frame. */
export class Cloud {
  constructor(count, role, size, opacity = 1) {
    this.role = role;
    this.attribute = new BufferAttribute(new Float32Array(count * 3), 3).setUsage(DynamicDrawUsage);
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", this.attribute);
    this.material = roundPoints(size, opacity);
    this.points = new Points(geometry, this.material);
    this.points.frustumCulled = false;
    this.paint();
  }

  paint() {
    this.material.uniforms.tint.value.set(colour(this.role));
  }

  set(values) {
    this.points.geometry.setDrawRange(0, keepVisible(values, this.attribute.array));
    this.attribute.needsUpdate = true;
  }
}
