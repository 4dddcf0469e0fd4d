// The wizard for pictures: a file or a folder is looked at, boxes are drawn on the first picture or typed, and a job makes
// the scene. Everything that the mouse does stands in fields of numbers, too, which the keyboard reaches.

import { unzip, zip } from "fflate";
import { ask, filesOf, post, takesDrops, tell } from "./sending.js";

const PICTURED = /\.(png|jpe?g|npy|npz|json|pkl|csv|mp4|mkv|avi)$/i;
const ZIPPED = /\.zip$/i;
const FILM = /\.(mp4|mkv|avi)$/i;
const COLOURS = { object: "--accent", patch: "--warn", held: "--good" };
/** Half the side of the patch that a click takes, in pixels. */
const CLICK = 20;
/** Half the sides of a box that a click in space makes, in pixels. */
const SPACE_CLICK = 40;

const form = document.querySelector("[data-tracking]");
const canvas = form.querySelector("canvas");
const camera = form.querySelector("[data-camera]");
/** Boxes by what they are around and the camera's number: [left, top, right, bottom]. */
const boxes = { object: {}, patch: {}, held: {} };
let chosen = null;
let shown = [];
let picture = null;
let drag = null;
let space = null;
let turn = 0;

const zipped = (tree) => new Promise((done, fail) => zip(tree, { level: 0 }, (error, data) => (error ? fail(error) : done(data))));
const unzipped = (bytes) => new Promise((done, fail) => unzip(bytes, (error, tree) => (error ? fail(error) : done(tree))));
const bytesOf = async (file) => new Uint8Array(await file.arrayBuffer());

/** Pictures, [path, File] each, as one zip. */
async function packed(name, files) {
  const tree = {};
  for (const [path, file] of files) if (PICTURED.test(path)) tree[path] = await bytesOf(file);
  if (!Object.keys(tree).length) throw new Error(`The folder ${name} holds no pictures.`);
  return new File([await zipped(tree)], `${name}.zip`, { type: "application/zip" });
}

/** A robot's log and what came with it: of LeRobot, the info.json that names its components. */
function logFiles() {
  const files = [...form.querySelector("[data-log]").files];
  return [files.find((one) => !/\.json$/i.test(one.name)), files];
}

/** The file with a robot's log beside what it holds. */
async function withLog(file, logs) {
  const tree = FILM.test(file.name) ? { [file.name]: await bytesOf(file) } : null;
  if (!tree && !ZIPPED.test(file.name)) throw new Error(`A log goes into a folder, a zip or beside a film, not into ${file.name}.`);
  const held = tree ?? (await unzipped(await bytesOf(file)));
  const top = Object.keys(held).find((path) => /(^|\/)(color|colour|rgb|image)\//.test(path)) ?? "";
  const folder = top.replace(/(color|colour|rgb|image)\/.*$/, "");
  for (const log of logs) held[`${folder}${log.name}`] = await bytesOf(log);
  return new File([await zipped(held)], `${file.name.replace(/\.[^.]+$/, "")}.zip`, { type: "application/zip" });
}

/** Of a box, its four fields. */
const corners = (name) => [...form.querySelectorAll(`[data-box="${name}"] input[data-corner]`)];
const number = () => Number(camera.value || 0);

function typed(name) {
  const values = corners(name).map((input) => input.valueAsNumber);
  return values.every(Number.isFinite) ? values : null;
}

function fill(name) {
  const box = boxes[name][number()];
  corners(name).forEach((input, at) => (input.value = box ? box[at] : ""));
}

function draw() {
  space?.dress(boxes);
  if (!picture) return;
  const pen = canvas.getContext("2d");
  pen.drawImage(picture, 0, 0);
  const style = getComputedStyle(form);
  pen.lineWidth = Math.max(2, picture.width / 320);
  for (const [name, colour] of Object.entries(COLOURS)) {
    const box = boxes[name][number()];
    if (!box) continue;
    pen.strokeStyle = style.getPropertyValue(colour);
    pen.strokeRect(box[0], box[1], box[2] - box[0], box[3] - box[1]);
  }
}

async function showCamera() {
  const one = shown[number()];
  picture = null;
  if (one?.media_type) {
    const bytes = Uint8Array.from(atob(one.data), (letter) => letter.charCodeAt(0));
    picture = await createImageBitmap(new Blob([bytes], { type: one.media_type }));
    canvas.width = picture.width;
    canvas.height = picture.height;
  }
  canvas.hidden = !picture;
  form.querySelector("[data-unseen]").hidden = Boolean(picture);
  for (const name of Object.keys(boxes)) fill(name);
  for (const part of form.querySelectorAll("[data-first-camera]")) part.disabled = number() !== 0;
  draw();
}

/** What a preview has to know beside the file: which axis points up, and where the object is, which is no ground. */
function said(object) {
  const up = form.querySelector('[data-option="up"]').value;
  return up ? { up, boxes: object } : { boxes: object };
}

/** The first pictures in space, where they have depth; or why not. */
async function drawSpace({ cloud, unclouded }) {
  const figure = form.querySelector("[data-first]");
  const told = form.querySelector("[data-unclouded]");
  told.hidden = !unclouded;
  told.textContent = unclouded ? `The depth is not shown: ${unclouded}.` : "";
  figure.hidden = !cloud?.places_m.length;
  if (figure.hidden) return;
  figure.querySelector("[data-how]").textContent = [`Up is ${cloud.up}.`, ...cloud.warnings.map((one) => `${one}.`)].join(" ");
  try {
    const { First } = await import(figure.dataset.first);
    space ??= new First(figure, take);
    window.viewer = space; // for tests, which have no other way to see where a point is drawn
    space.draw(cloud);
    space.dress(boxes);
  } catch {
    figure.hidden = true; // a browser without WebGL draws boxes on the picture all the same
  }
}

/** Put the box that is chosen around a pixel of a camera that was clicked in space. */
async function take(of, [column, row]) {
  const name = form.querySelector("input[name=draws]:checked").value;
  if (name !== "object" && of !== 0) return tell(form, "The gripper's boxes are those of camera 0; this point is seen by another.");
  if (of !== number()) {
    camera.value = of;
    await showCamera();
  }
  const box = boxes[name][of];
  const half = name === "patch" ? [CLICK, CLICK] : box ? [(box[2] - box[0]) / 2, (box[3] - box[1]) / 2] : [SPACE_CLICK, SPACE_CLICK];
  const sides = [column - half[0], row - half[1], column + half[0], row + half[1]].map(Math.round);
  boxes[name][of] = picture ? inside(sides) : sides;
  if (name === "patch") form.querySelector("[data-gripper]").value = "patch";
  fill(name);
  draw();
}

/** The part of a box that is in the picture. */
const inside = ([left, top, right, bottom]) => [
  Math.max(left, 0), Math.max(top, 0), Math.min(right, canvas.width), Math.min(bottom, canvas.height),
];

/** Another axis points up: the cloud is turned, what was drawn stays. */
async function lookAgain() {
  if (!chosen) return;
  const mine = (turn += 1);
  const found = await ask(form, chosen, said(boxes.object), true);
  if (found && mine === turn) await drawSpace(found);
}

async function look(file) {
  turn += 1;
  const found = await ask(form, file, said({}));
  if (!found) return;
  for (const box of Object.values(boxes)) for (const key of Object.keys(box)) delete box[key];
  chosen = file;
  shown = found.cameras;
  camera.replaceChildren(...shown.map((one) => new Option(`${one.camera} (${one.name})`, one.camera)));
  camera.closest("label").hidden = shown.length < 2;
  form.querySelector("[data-film]").hidden = found.form !== "film";
  const frames = shown[0].frames ? `, ${shown[0].frames} pictures each` : "";
  tell(form, `${file.name}: ${shown.length} ${shown.length > 1 ? "cameras" : "camera"}${frames}`);
  form.querySelector("[data-options]").hidden = false;
  await showCamera();
  await drawSpace(found);
}

/** Where the mouse is, in pixels of the picture. */
function place(event) {
  const area = canvas.getBoundingClientRect();
  const column = ((event.clientX - area.left) / area.width) * canvas.width;
  const row = ((event.clientY - area.top) / area.height) * canvas.height;
  return [Math.round(Math.min(Math.max(column, 0), canvas.width)), Math.round(Math.min(Math.max(row, 0), canvas.height))];
}

function drawn(end) {
  const name = form.querySelector("input[name=draws]:checked").value;
  const [start, click] = [drag, Math.hypot(end[0] - drag[0], end[1] - drag[1]) < 4];
  if (click && name !== "patch") return;
  boxes[name][number()] = click
    ? [start[0] - CLICK, start[1] - CLICK, start[0] + CLICK, start[1] + CLICK]
    : [Math.min(start[0], end[0]), Math.min(start[1], end[1]), Math.max(start[0], end[0]), Math.max(start[1], end[1])];
  if (name === "patch") form.querySelector("[data-gripper]").value = "patch";
  fill(name);
  draw();
}

/** What was drawn and typed: a TrackingOptions. */
function optionsOf() {
  const options = { boxes: boxes.object };
  const body = {};
  for (const input of form.querySelectorAll("[data-option], [data-fact]")) {
    if (input.type === "checkbox") {
      if (input.checked) options[input.dataset.option] = true;
      continue;
    }
    const value = input.type === "number" ? input.valueAsNumber : input.value.trim();
    if (value === "" || Number.isNaN(value)) continue;
    if (input.dataset.fact) body[input.dataset.fact] = value;
    else options[input.dataset.option] = value;
  }
  if (Object.keys(body).length) options.body = body;
  const moved = form.querySelector("[data-gripper]").value;
  if (moved !== "none") {
    options.gripper = {};
    if (moved === "patch") options.gripper.patch = boxes.patch[0] ?? null;
    if (moved === "marker") options.gripper.marker = form.querySelector("[data-marker]").valueAsNumber || 0;
    if (moved === "log") {
      const pose = form.querySelector("[data-log-pose]").value.trim();
      const episode = form.querySelector("[data-log-episode]").valueAsNumber;
      options.gripper.log = logFiles()[0]?.name ?? null;
      if (pose) options.gripper.log_pose = pose;
      if (!Number.isNaN(episode)) options.gripper.log_episode = episode;
      const base = form.querySelector("[data-log-base]").value.trim();
      if (base) options.gripper.log_base = base.split(/[\s,]+/).map(Number);
    }
    if (boxes.held[0]) options.gripper.held_px = boxes.held[0];
  }
  if (!form.querySelector("[data-film]").hidden) {
    const board = form.querySelector("[data-board]").value.trim();
    const scale = [...form.querySelectorAll("[data-scale]")].map((input) => input.valueAsNumber);
    const length = form.querySelector("[data-length]").valueAsNumber;
    options.plane = board ? { board } : { pixels: scale, length_m: length };
  }
  return options;
}

async function start() {
  try {
    const options = optionsOf();
    const file = options.gripper?.log ? await withLog(chosen, logFiles()[1]) : chosen;
    post(form, file, options, "Storing the pictures …");
  } catch (error) {
    tell(form, error.message);
  }
}

form.addEventListener("submit", (event) => {
  event.preventDefault();
  const file = form.querySelector("#pictures").files[0];
  const folder = [...form.querySelector("#folder").files];
  if (file) return look(file);
  if (!folder.length) return tell(form, "Choose a file or a folder.");
  const name = folder[0].webkitRelativePath.split("/")[0];
  const files = folder.map((one) => [one.webkitRelativePath.slice(name.length + 1), one]);
  return packed(name, files).then(look, (error) => tell(form, error.message));
});
form.querySelector("[data-start]").addEventListener("click", start);
camera.addEventListener("change", showCamera);
form.querySelector('[data-option="up"]').addEventListener("change", lookAgain);
for (const name of Object.keys(boxes)) {
  for (const input of corners(name)) {
    input.addEventListener("input", () => {
      const box = typed(name);
      if (box) boxes[name][number()] = box;
      else delete boxes[name][number()];
      draw();
    });
  }
}
canvas.addEventListener("pointerdown", (event) => {
  drag = place(event);
  canvas.setPointerCapture(event.pointerId);
  event.preventDefault();
});
canvas.addEventListener("pointermove", (event) => drag && drawn(place(event)));
canvas.addEventListener("pointerup", (event) => {
  if (drag) drawn(place(event));
  drag = null;
});
takesDrops(form, async (entry, file) => {
  if (entry?.isDirectory) await look(await packed(entry.name, (await filesOf(entry)).map(([path, one]) => [path.slice(entry.name.length + 1), one])));
  else if (file) await look(file);
});
