// The recording beside the model: what was measured and what the twin predicts of it, at a moment of the recording, and
// where the recorded grips were then. `data-ghost` answers with what `clouds.py` describes and `start_s`.

import { Cloud } from "./points.js";

export class Ghost {
  static async load(url) {
    const answer = await fetch(url);
    const data = answer.ok ? await answer.json() : null;
    return data && new Ghost(data);
  }

  constructor(data) {
    this.times = data.times;
    this.start = data.start_s;
    this.layers = new Map(data.layers.map((spec) => [spec.name, { spec, values: null, cloud: null }]));
  }

  has(name) {
    return this.layers.has(name);
  }

  get end() {
    return this.times.at(-1);
  }

  /** The layer's values, (frames, count, 3) in one array. */
  async values(name) {
    const layer = this.layers.get(name);
    layer.loading ??= fetch(layer.spec.url).then(async (answer) => {
      if (!answer.ok) throw new Error(await answer.text());
      layer.values = new Float32Array(await answer.arrayBuffer());
    });
    await layer.loading;
    return layer.values;
  }

  /** Begin or end to draw a layer. */
  async show(name, scene, shown) {
    const layer = this.layers.get(name);
    if (!layer) return;
    if (shown && !layer.cloud) {
      await this.values(name);
      layer.cloud = new Cloud(layer.spec.count, layer.spec.role, layer.spec.size * 0.8, 0.55);
      scene.add(layer.cloud.points);
    }
    if (layer.cloud) layer.cloud.points.visible = shown;
  }

  get clouds() {
    return [...this.layers.values()].map((layer) => layer.cloud).filter(Boolean);
  }

  /** Draw the frame nearest to a moment of the recording [s]. */
  at(time) {
    let frame = 0;
    while (frame + 1 < this.times.length && this.times[frame + 1] <= time) frame += 1;
    if (frame === this.frame && !this.stale) return;
    this.frame = frame;
    this.stale = false;
    for (const { cloud, values, spec } of this.layers.values()) {
      if (cloud) cloud.set(values.subarray(frame * spec.count * 3, (frame + 1) * spec.count * 3));
    }
  }

  /** The middle of some recorded controllers at a moment, between the frames. */
  grip(members, time, target) {
    const { spec, values } = this.layers.get("controllers");
    let right = this.times.findIndex((one) => one >= time);
    if (right < 0) right = this.times.length - 1;
    const left = Math.max(right - 1, 0);
    const span = this.times[right] - this.times[left];
    const share = span > 0 ? Math.min(1, Math.max(0, (time - this.times[left]) / span)) : 1;
    const sum = [0, 0, 0];
    for (const index of members) {
      for (let axis = 0; axis < 3; axis += 1) {
        const at = (frame) => values[(frame * spec.count + index) * 3 + axis];
        sum[axis] += ((1 - share) * at(left) + share * at(right)) / members.length;
      }
    }
    return target.set(...sum);
  }
}
