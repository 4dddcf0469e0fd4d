// What happened in the playground, to keep: the frames as arrays (npz) and the picture as a film (webm).
// The arrays: times (T,) [s], vertices (T, n, 3) and controllers (T, K, 3) [m], as a rollout's.

import { zipSync } from "fflate";

const MOST_FRAMES = 20_000; // about five minutes
const FILM_FPS = 30;

export class Recorder {
  constructor(canvas) {
    this.canvas = canvas;
    this.running = false;
    this.files = {};
  }

  start() {
    for (const url of Object.values(this.files)) URL.revokeObjectURL(url);
    this.files = {};
    this.times = [];
    this.frames = [];
    this.parts = [];
    this.running = true;
    if (!this.canvas.captureStream || !window.MediaRecorder) return;
    const type = ["video/webm;codecs=vp9", "video/webm", "video/mp4"].find((one) => MediaRecorder.isTypeSupported(one));
    this.film = type && new MediaRecorder(this.canvas.captureStream(FILM_FPS), { mimeType: type });
    if (!this.film) return;
    this.film.ondataavailable = (event) => this.parts.push(event.data);
    this.film.start(1000);
  }

  /** A frame of the session: when, and its places. */
  take(time, values) {
    if (!this.running || this.frames.length >= MOST_FRAMES) return;
    this.times.push(time);
    this.frames.push(values.slice());
  }

  /** The addresses of what was recorded: `arrays`, and `film` where the browser makes films. */
  async stop(points, controllers) {
    this.running = false;
    if (this.film && this.film.state !== "inactive") {
      const ended = new Promise((resolve) => { this.film.onstop = resolve; });
      this.film.stop();
      await ended;
      const [kind] = this.film.mimeType.split(";");
      if (this.parts.length) this.files.film = URL.createObjectURL(new Blob(this.parts, { type: kind }));
      this.ending = kind.endsWith("mp4") ? "mp4" : "webm";
    }
    const count = this.frames.length;
    const split = 3 * points;
    const [vertices, grips] = [new Float32Array(count * split), new Float32Array(count * 3 * controllers)];
    this.frames.forEach((values, frame) => {
      vertices.set(values.subarray(0, split), frame * split);
      grips.set(values.subarray(split), frame * 3 * controllers);
    });
    const archive = zipSync({
      "times.npy": npy(new Float64Array(this.times), [count]),
      "vertices.npy": npy(vertices, [count, points, 3]),
      "controllers.npy": npy(grips, [count, controllers, 3]),
    }, { level: 0 });
    this.files.arrays = URL.createObjectURL(new Blob([archive], { type: "application/octet-stream" }));
    return this.files;
  }
}

/** An array in NumPy's format, version 1.0. */
function npy(values, shape) {
  const kind = values instanceof Float64Array ? "<f8" : "<f4";
  const told = `{'descr': '${kind}', 'fortran_order': False, 'shape': (${shape.join(", ")}${shape.length === 1 ? "," : ""}), }`;
  const length = Math.ceil((10 + told.length + 1) / 64) * 64;
  const head = new TextEncoder().encode(`\x93NUMPY\x01\x00\x00\x00${told.padEnd(length - 11)}\n`.slice(1));
  const bytes = new Uint8Array(length + values.byteLength);
  bytes[0] = 0x93;
  bytes.set(head, 1);
  new DataView(bytes.buffer).setUint16(8, length - 10, true);
  bytes.set(new Uint8Array(values.buffer, values.byteOffset, values.byteLength), length);
  return bytes;
}
