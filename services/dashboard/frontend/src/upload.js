// Uploads: a file, or a folder that is packed here, with a bar; the server's faults are shown where the file was dropped.
// A table of markers is looked at first: what would be guessed is shown and drawn, and stored when it is confirmed.
// Without this script the form posts the file as any form does.

import { zip } from "fflate";
import { ask, filesOf, post, takesDrops, tell } from "./sending.js";

const TABLE = /\.(csv|tsv|txt|dat|trc|c3d|npz|h5|hdf5|mcap)$/i;
const PACKED = /\.(json|npz|obj|off|ply|stl)$/i;

/** A folder as one zip, its own name left out of the paths; what is no part of a scene is left out. */
async function packed(entry) {
  const files = (await filesOf(entry)).filter(([path]) => PACKED.test(path));
  const tree = {};
  for (const [path, file] of files) {
    tree[path.slice(entry.name.length + 1)] = [new Uint8Array(await file.arrayBuffer()), { level: 0 }];
  }
  if (!("scene.json" in tree && "scene.npz" in tree)) {
    const held = Object.keys(tree).slice(0, 8).join(", ") || "neither";
    throw new Error(`The folder ${entry.name} lacks scene.json or scene.npz; it holds ${held}.`);
  }
  const bytes = await new Promise((done, fail) => zip(tree, (error, data) => (error ? fail(error) : done(data))));
  return new File([bytes], `${entry.name}.zip`, { type: "application/zip" });
}

/** What a person said beside the file: the fields of a SceneImport that are filled. */
function optionsOf(form) {
  const options = {};
  const body = {};
  for (const input of form.querySelectorAll("[data-option], [data-fact], [data-names]")) {
    const value = input.type === "number" ? input.valueAsNumber : input.value.trim();
    if (value === "" || Number.isNaN(value)) continue;
    if (input.dataset.fact) body[input.dataset.fact] = value;
    else if (input.dataset.option) options[input.dataset.option] = value;
    else options[input.dataset.names] = value.split(",").map((name) => name.trim());
  }
  return Object.keys(body).length ? { ...options, body } : options;
}

/** The guesses as a table, what is left out below it. */
function show(form, found) {
  tell(form, `${found.importer}: this was found, nothing is stored yet`);
  const table = document.createElement("table");
  const cells = (row, kind, texts) =>
    row.append(...texts.map((text) => Object.assign(document.createElement(kind), { textContent: text })));
  cells(table.createTHead().insertRow(), "th", ["what", "value", "how"]);
  const rows = table.createTBody();
  for (const guess of found.guesses) cells(rows.insertRow(), "td", [guess.what, guess.value, guess.how]);
  const lines = document.createElement("ul");
  for (const line of found.lines) lines.append(Object.assign(document.createElement("li"), { textContent: line }));
  form.querySelector("[data-told]").append(table, lines);
}

/** Ask what an import would guess; the options are there for what it could not, or guessed wrongly. */
async function look(form, file) {
  form.looked = file;
  const turn = (form.turn = (form.turn ?? 0) + 1);
  const options = optionsOf(form);
  const found = await ask(form, file, options);
  if (turn !== form.turn) return; // something else was clicked meanwhile
  form.querySelector("[data-options]").hidden = false;
  if (found) show(form, found);
  const unheld = !found && form.querySelector("[data-told]").textContent.includes("--gripper");
  const drawn = unheld ? await ask(form, file, { ...options, controllers: ["none"] }, true) : found;
  if (turn === form.turn) await draw(form, drawn);
}

/** Draw the markers, where there are any; what is clicked in the drawing goes into the form, which is looked at again. */
async function draw(form, found) {
  const figure = form.querySelector("[data-markers]");
  figure.hidden = !found?.markers.length;
  if (figure.hidden) return;
  try {
    const { Markers } = await import(figure.dataset.markers);
    form.viewer ??= new Markers(figure, (chosen) => {
      for (const [name, value] of Object.entries(chosen)) {
        form.querySelector(`[data-option="${name}"], [data-names="${name}"]`).value = value;
      }
      look(form, form.looked);
    });
    window.viewer = form.viewer; // for tests, which have no other way to see where a marker is drawn
    form.viewer.draw(found);
  } catch (error) {
    figure.hidden = true; // no WebGL: the table and the fields say the same
    console.warn(error);
  }
}

function bring(form, file) {
  if (TABLE.test(file.name) && form.querySelector("[data-options]")) look(form, file);
  else send(form, file);
}

function send(form, file) {
  post(form, file, form.looked === file ? optionsOf(form) : null, "Checking the recording …");
}

for (const form of document.querySelectorAll("[data-upload]")) {
  form.addEventListener("submit", (event) => {
    const file = form.querySelector('input[type="file"]').files[0];
    if (!file) return;
    event.preventDefault();
    bring(form, file);
  });
  form.querySelector("[data-look]")?.addEventListener("click", () => look(form, form.looked));
  form.querySelector("[data-store]")?.addEventListener("click", () => send(form, form.looked));
  takesDrops(form, async (entry, file) => {
    if (entry?.isDirectory) send(form, await packed(entry));
    else if (file) bring(form, file);
  });
}
