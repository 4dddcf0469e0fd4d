// Uploads: a file, or a folder that is packed here, with a bar; the server's faults are shown where the file was dropped.
// Without this script the form posts the file as any form does.

import { zip } from "fflate";

const PACKED = /\.(json|npz|obj|off|ply|stl)$/i;

/** Every file below a dropped entry as [path within the folder, File]. */
async function filesOf(entry, path = "") {
  if (entry.isFile) return [[path + entry.name, await new Promise((done, fail) => entry.file(done, fail))]];
  const reader = entry.createReader();
  const found = [];
  for (;;) {
    const some = await new Promise((done, fail) => reader.readEntries(done, fail));
    if (!some.length) return found;
    for (const inner of some) found.push(...(await filesOf(inner, `${path}${entry.name}/`)));
  }
}

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

function tell(form, told, faults = []) {
  const place = form.querySelector("[data-told]");
  place.replaceChildren();
  const line = document.createElement("p");
  line.className = faults.length || told.endsWith(".") ? "fault" : "quiet";
  line.textContent = told;
  place.append(line);
  if (!faults.length) return;
  const list = document.createElement("ul");
  for (const fault of faults) list.append(Object.assign(document.createElement("li"), { textContent: fault }));
  place.append(list);
}

function send(form, file) {
  const bar = form.querySelector("progress");
  const request = new XMLHttpRequest();
  request.open("POST", form.action);
  request.setRequestHeader("Accept", "application/json");
  request.upload.addEventListener("progress", (event) => {
    if (event.lengthComputable) bar.value = event.loaded / event.total;
    if (event.loaded === event.total) tell(form, "Checking the recording …");
  });
  request.addEventListener("load", () => {
    bar.hidden = true;
    let answer = {};
    try {
      answer = JSON.parse(request.responseText);
    } catch {
      answer = { told: `The service answered ${request.status}.` };
    }
    if (answer.place) location.assign(answer.place);
    else tell(form, answer.told ?? `The service answered ${request.status}.`, answer.faults);
  });
  request.addEventListener("error", () => {
    bar.hidden = true;
    tell(form, "The service does not answer; nothing was stored.");
  });
  bar.hidden = false;
  bar.value = 0;
  tell(form, `Uploading ${file.name} …`);
  const body = new FormData();
  body.append("bundle", file, file.name);
  request.send(body);
}

for (const form of document.querySelectorAll("[data-upload]")) {
  form.addEventListener("submit", (event) => {
    const file = form.querySelector('input[type="file"]').files[0];
    if (!file) return;
    event.preventDefault();
    send(form, file);
  });
  form.addEventListener("dragover", (event) => {
    event.preventDefault();
    form.classList.add("over");
  });
  form.addEventListener("dragleave", () => form.classList.remove("over"));
  form.addEventListener("drop", async (event) => {
    event.preventDefault();
    form.classList.remove("over");
    const item = event.dataTransfer.items[0];
    const entry = item?.webkitGetAsEntry?.();
    const file = event.dataTransfer.files[0];
    try {
      if (entry?.isDirectory) send(form, await packed(entry));
      else if (file) send(form, file);
    } catch (error) {
      tell(form, error.message);
    }
  });
}
