// 3D view of a trace's page: measured and predicted points over time on plain canvases, turned and zoomed together.
// A click on a chart moves the view to that time; the view moves the charts' playheads.
"use strict";
for (const view of document.querySelectorAll(".view")) {
  const data = JSON.parse(view.querySelector("[data-points]").textContent);
  const unpack = (text) => {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const steps = new Int16Array(bytes.buffer);
    return Float32Array.from(steps, (s) => (s === -32768 ? NaN : (s / 32767) * data.size));
  };
  const clouds = Object.fromEntries(Object.entries(data.clouds).map(([name, text]) => [name, unpack(text)]));
  const grips = unpack(data.grips);
  const frames = data.times.length;
  const extent = data.high.map((h, k) => h - data.low[k]);
  const centre = extent.map((e) => e / 2);
  const radius = Math.max(Math.hypot(...extent) / 2, 1e-6);
  const canvases = [...view.querySelectorAll("canvas")];
  const slider = view.querySelector("[data-slider]");
  const clock = view.querySelector("[data-clock]");
  const play = view.querySelector("[data-play]");
  const mode = view.querySelector("[data-mode]");
  const state = { yaw: -0.55, pitch: 0.34, zoom: 1, frame: 0, playing: false };
  slider.max = frames - 1;

  const token = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const channels = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));
  const mix = (stops, t) => {
    const at = Math.min(Math.max(t, 0), 1) * (stops.length - 1);
    const k = Math.min(Math.floor(at), stops.length - 2);
    return `rgb(${stops[k].map((c, i) => Math.round(c + (at - k) * (stops[k + 1][i] - c))).join(" ")})`;
  };

  const errorAt = (cloud, frame, i) => {
    const o = (frame * data.count + i) * 3;
    const m = clouds.measured;
    return Math.hypot(m[o] - cloud[o], m[o + 1] - cloud[o + 1], m[o + 2] - cloud[o + 2]) / Math.sqrt(3);
  };
  const largest = (() => {
    const found = [];
    for (let f = 0; f < frames; f += Math.max(1, Math.floor(frames / 60))) {
      for (let i = 0; i < data.count; i += 1) {
        const e = errorAt(clouds.before, f, i);
        if (!Number.isNaN(e)) found.push(e);
      }
    }
    found.sort((a, b) => a - b);
    return found[Math.floor(0.97 * (found.length - 1))] || 1e-3;
  })();
  view.querySelector("[data-top]").textContent = `${(largest * 1000).toPrecision(2)} mm`;

  const spacing = (() => {
    const m = clouds.before;
    const nearest = [];
    for (let i = 0; i < data.count; i += 1) {
      let best = Infinity;
      for (let j = 0; j < data.count; j += 1) {
        const d = Math.hypot(m[3 * i] - m[3 * j], m[3 * i + 1] - m[3 * j + 1], m[3 * i + 2] - m[3 * j + 2]);
        if (j !== i && d < best) best = d;
      }
      nearest.push(best);
    }
    nearest.sort((a, b) => a - b);
    return Math.min(nearest[nearest.length >> 1], radius);
  })();

  const telling = (() => {
    let [best, most] = [data.split < frames ? data.split : 0, -1];
    for (let f = best; f < frames; f += 1) {
      let [total, seen] = [0, 0];
      for (let i = 0; i < data.count; i += 1) {
        const e = errorAt(clouds.before, f, i);
        if (!Number.isNaN(e)) { total += e * e; seen += 1; }
      }
      if (seen && total / seen > most) [best, most] = [f, total / seen];
    }
    return best;
  })();

  function draw(canvas) {
    const pane = canvas.dataset.pane;
    const cloud = clouds[pane];
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth: width, clientHeight: height } = canvas;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const [cy, sy] = [Math.cos(state.yaw), Math.sin(state.yaw)];
    const [cp, sp] = [Math.cos(state.pitch), Math.sin(state.pitch)];
    const scale = ((Math.min(width, height) / 2) * 0.94 * state.zoom) / radius;
    const project = (x, y, z) => {
      const [a, b, c] = [x - centre[0], y - centre[1], z - centre[2]];
      const right = cy * a + sy * b;
      const away = -sy * a + cy * b;
      return [width / 2 + scale * right, height / 2 - scale * (cp * c + sp * away), cp * away - sp * c];
    };
    const at = (values, o) => project(values[o], values[o + 1], values[o + 2]);
    const segment = (p, q) => { context.moveTo(p[0], p[1]); context.lineTo(q[0], q[1]); };

    const ground = (data.floor ?? data.low[2] - 0.04 * radius) - data.low[2];
    const power = 10 ** Math.floor(Math.log10((2 * radius) / 6));
    const step = [1, 2, 5, 10].map((k) => k * power).find((k) => k >= (2 * radius) / 6);
    const half = Math.ceil((radius * 1.05) / step) * step;
    context.strokeStyle = token("--line");
    context.lineWidth = 1;
    context.beginPath();
    for (let k = -half; k <= half + step / 2; k += step) {
      segment(project(centre[0] + k, centre[1] - half, ground), project(centre[0] + k, centre[1] + half, ground));
      segment(project(centre[0] - half, centre[1] + k, ground), project(centre[0] + half, centre[1] + k, ground));
    }
    context.stroke();
    context.fillStyle = token("--quiet");
    context.font = "11px system-ui, sans-serif";
    context.fillText(`grid ${step >= 1 ? `${step} m` : `${+(step * 100).toPrecision(2)} cm`}`, 10, height - 10);

    const base = state.frame * data.count * 3;
    context.strokeStyle = token("--quiet");
    context.globalAlpha = 0.55;
    context.beginPath();
    for (const [a, b] of data.edges) segment(at(cloud, base + 3 * a), at(cloud, base + 3 * b));
    context.stroke();
    context.globalAlpha = 0.8;
    context.strokeStyle = token("--error");
    context.beginPath();
    for (let i = 0; i < data.count; i += 1) {
      const o = base + 3 * i;
      if (!Number.isNaN(clouds.measured[o])) segment(at(clouds.measured, o), at(cloud, o));
    }
    context.stroke();
    context.globalAlpha = 1;

    const size = Math.max(1.6, Math.min(6, 0.42 * spacing * scale));
    const stops = ["--heat-0", "--heat-1", "--heat-2"].map((name) => channels(token(name)));
    const fixed = mode.value === "now" ? null : data.rms[pane][mode.value];
    const order = [...Array(data.count).keys()].map((i) => [at(cloud, base + 3 * i), i]);
    order.sort((p, q) => q[0][2] - p[0][2]);
    const missing = token("--line");
    for (const [p, i] of order) {
      const error = fixed ? fixed[i] : errorAt(cloud, state.frame, i);
      context.fillStyle = error === null || Number.isNaN(error) ? missing : mix(stops, Math.sqrt(error / largest));
      context.beginPath();
      context.arc(p[0], p[1], size, 0, 7);
      context.fill();
    }
    context.strokeStyle = token("--measured");
    context.lineWidth = Math.min(1.4, 0.4 * size);
    for (let i = 0; i < data.count; i += 1) {
      if (Number.isNaN(clouds.measured[base + 3 * i])) continue;
      const p = at(clouds.measured, base + 3 * i);
      context.beginPath();
      context.arc(p[0], p[1], size + 1, 0, 7);
      context.stroke();
    }
    context.fillStyle = token("--ink");
    for (let i = 0; i < data.grip_count; i += 1) {
      const p = at(grips, (state.frame * data.grip_count + i) * 3);
      context.fillRect(p[0] - 2.5, p[1] - 2.5, 5, 5);
    }
    let total = 0;
    let seen = 0;
    for (let i = 0; i < data.count; i += 1) {
      const error = fixed ? fixed[i] : errorAt(cloud, state.frame, i);
      if (error !== null && !Number.isNaN(error)) { total += error * error; seen += 1; }
    }
    const label = view.querySelector(`[data-rms="${pane}"]`);
    label.textContent = seen ? `rms ${(1000 * Math.sqrt(total / seen)).toPrecision(3)} mm` : "nothing seen";
  }

  function show(frame) {
    state.frame = Math.max(0, Math.min(frames - 1, frame));
    slider.value = state.frame;
    const time = data.times[state.frame];
    clock.textContent = `${time.toFixed(2)} s · ${state.frame >= data.split ? "held out" : "training"}`;
    for (const chart of document.querySelectorAll("svg[data-time]")) {
      const [from, to] = chart.dataset.time.split(" ").map(Number);
      const [left, right] = chart.dataset.span.split(" ").map(Number);
      const line = chart.querySelector(".playhead");
      const own = chart.closest("[data-linked]") !== null;
      const x = left + ((time - from) / (to - from || 1)) * (right - left);
      line.style.display = own && time >= from && time <= to ? "inline" : "none";
      line.setAttribute("x1", x);
      line.setAttribute("x2", x);
    }
    canvases.forEach(draw);
    view.dataset.ready = "true";
  }

  function run() {
    state.playing = !state.playing;
    play.textContent = state.playing ? "Pause" : "Play";
    if (!state.playing) return;
    if (state.frame >= frames - 1) show(0);
    let last = performance.now();
    let time = data.times[state.frame];
    const step = (now) => {
      if (!state.playing) return;
      time += (now - last) / 1000;
      last = now;
      let frame = state.frame;
      while (frame < frames - 1 && data.times[frame + 1] <= time) frame += 1;
      if (frame !== state.frame) show(frame);
      if (frame >= frames - 1) { state.playing = false; play.textContent = "Play"; } else requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  const still = () => { state.playing = false; play.textContent = "Play"; };
  const redraw = () => canvases.forEach(draw);
  play.addEventListener("click", run);
  slider.addEventListener("input", () => { still(); show(Number(slider.value)); });
  mode.addEventListener("change", redraw);
  for (const canvas of canvases) {
    let from = null;
    canvas.addEventListener("pointerdown", (event) => { from = [event.clientX, event.clientY]; canvas.setPointerCapture(event.pointerId); });
    canvas.addEventListener("pointerup", () => { from = null; });
    canvas.addEventListener("pointermove", (event) => {
      if (!from) return;
      state.yaw += (event.clientX - from[0]) * 0.008;
      state.pitch = Math.max(-1.5, Math.min(1.5, state.pitch + (event.clientY - from[1]) * 0.008));
      from = [event.clientX, event.clientY];
      redraw();
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      state.zoom = Math.max(0.3, Math.min(12, state.zoom * Math.exp(-event.deltaY * 0.0012)));
      redraw();
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const turn = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
      if (!turn) return;
      event.preventDefault();
      state.yaw += turn[0];
      state.pitch = Math.max(-1.5, Math.min(1.5, state.pitch + turn[1]));
      redraw();
    });
  }
  for (const chart of document.querySelectorAll("[data-linked] svg[data-time]")) {
    chart.addEventListener("click", (event) => {
      const [from, to] = chart.dataset.time.split(" ").map(Number);
      const [left, right] = chart.dataset.span.split(" ").map(Number);
      const box = chart.getBoundingClientRect();
      const x = ((event.clientX - box.left) / box.width) * chart.viewBox.baseVal.width;
      const time = from + ((x - left) / (right - left)) * (to - from);
      still();
      show(data.times.reduce((best, t, k) => (Math.abs(t - time) < Math.abs(data.times[best] - time) ? k : best), 0));
    });
  }
  new ResizeObserver(redraw).observe(view);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  show(telling);
}
