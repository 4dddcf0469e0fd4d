// Curves of a page: every `<div data-curve="URL">` becomes a uPlot chart of the JSON found there:
// { x: {label}, y: {label, unit}, times: [...], split: number | null, series: [{label, role, values}] }.
// A `frame` event of the page's 3D view moves the cursor line; a click on the chart seeks in the view.

import uPlot from "uplot";
import { colour, onSchemeChange } from "./palette.js";

const HEIGHT_PX = 260;

function axis(label, size) {
  return {
    label,
    labelSize: 18,
    labelGap: 0,
    labelFont: "12px system-ui, sans-serif",
    font: "11px system-ui, sans-serif",
    size,
    stroke: colour("quiet"),
    grid: { stroke: colour("line"), width: 1 },
    ticks: { stroke: colour("line"), width: 1, size: 4 },
  };
}

/** Shades the frames from `split` on, those that no calibration or training has seen. */
function shadeHeldOut(chart, split) {
  const { left, top, width, height } = chart.bbox;
  const from = Math.max(left, chart.valToPos(split, "x", true));
  if (from >= left + width) return;
  const context = chart.ctx;
  context.save();
  context.fillStyle = colour("held-out");
  context.fillRect(from, top, left + width - from, height);
  context.fillStyle = colour("quiet");
  context.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
  context.textAlign = "left";
  context.textBaseline = "top";
  context.fillText("held out", from + 6 * devicePixelRatio, top + 5 * devicePixelRatio);
  context.restore();
}

function drawPlayhead(chart, time) {
  if (time === null) return;
  const x = Math.round(chart.valToPos(time, "x", true));
  const { top, height, left, width } = chart.bbox;
  if (x < left || x > left + width) return;
  chart.ctx.fillStyle = colour("accent");
  chart.ctx.fillRect(x, top, Math.max(1, devicePixelRatio), height);
}

function number(value) {
  return value == null ? "–" : Number(value).toPrecision(3);
}

function options(data, state, element) {
  return {
    width: element.clientWidth,
    height: HEIGHT_PX,
    padding: [10, 12, 0, 0],
    scales: { x: { time: false }, y: { range: (_, low, high) => [Math.min(0, low), high > 0 ? high * 1.06 : 1] } },
    cursor: { points: { size: 7 }, drag: { x: true, y: false } },
    axes: [axis(data.x.label, 30), axis(data.y.label, 46)],
    series: [
      { label: data.x.label, value: (_, value) => number(value) },
      ...data.series.map((series) => ({
        label: series.label,
        stroke: colour(series.role),
        width: series.bold ? 2 : 1.5,
        dash: series.bold ? undefined : [5, 3],
        points: { show: false },
        value: (_, value) => (value == null ? "–" : `${number(value)} ${data.y.unit}`),
      })),
    ],
    hooks: {
      drawAxes: data.split == null ? [] : [(chart) => shadeHeldOut(chart, data.split)],
      draw: [(chart) => drawPlayhead(chart, state.time)],
    },
  };
}

async function mount(element) {
  const response = await fetch(element.dataset.curve);
  if (!response.ok) {
    element.textContent = `The curve could not be loaded (${response.status}).`;
    return;
  }
  const data = await response.json();
  const columns = [data.times, ...data.series.map((series) => series.values)];
  const state = { time: null };
  let chart = null;
  const draw = () => {
    chart?.destroy();
    chart = new uPlot(options(data, state, element), columns, element);
    chart.over.addEventListener("click", () => {
      if (chart.cursor.left < 0) return;
      document.dispatchEvent(new CustomEvent("seek", { detail: chart.posToVal(chart.cursor.left, "x") }));
    });
  };
  element.replaceChildren();
  draw();
  element.dataset.ready = "true";
  new ResizeObserver(() => {
    if (element.clientWidth) chart.setSize({ width: element.clientWidth, height: HEIGHT_PX });
  }).observe(element);
  onSchemeChange(draw);
  if (element.dataset.follow !== undefined) {
    document.addEventListener("frame", (event) => {
      state.time = event.detail;
      chart.redraw(false);
    });
  }
}

for (const element of document.querySelectorAll("[data-curve]")) mount(element);
