// What pages that take recordings share: files of a dropped folder, what is told of an upload, the upload itself.

/** Every file below a dropped entry as [path within the folder, File]. */
export async function filesOf(entry, path = "") {
  if (entry.isFile) return [[path + entry.name, await new Promise((done, fail) => entry.file(done, fail))]];
  const reader = entry.createReader();
  const found = [];
  for (;;) {
    const some = await new Promise((done, fail) => reader.readEntries(done, fail));
    if (!some.length) return found;
    for (const inner of some) found.push(...(await filesOf(inner, `${path}${entry.name}/`)));
  }
}

export function tell(form, told, faults = []) {
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

/** Post a file and what belongs to it to the form's address, with a bar; where that worked, go where the answer says. */
export function post(form, file, options, done) {
  const bar = form.querySelector("progress");
  const request = new XMLHttpRequest();
  request.open("POST", form.action);
  request.setRequestHeader("Accept", "application/json");
  request.upload.addEventListener("progress", (event) => {
    if (event.lengthComputable) bar.value = event.loaded / event.total;
    if (event.loaded === event.total) tell(form, done);
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
  if (options) body.append("options", JSON.stringify(options));
  request.send(body);
}

/** Ask the form's address what a file holds; the answer, or null where it was told why not, unless quietly. */
export async function ask(form, file, options, quietly = false) {
  if (!quietly) tell(form, `Looking at ${file.name} …`);
  const body = new FormData();
  body.append("bundle", file, file.name);
  if (options) body.append("options", JSON.stringify(options));
  try {
    const answer = await fetch(`${form.action}/preview`, { method: "POST", body, headers: { Accept: "application/json" } });
    const found = await answer.json();
    if (answer.ok) return found;
    if (!quietly) tell(form, found.told ?? `The service answered ${answer.status}.`, found.faults);
  } catch {
    if (!quietly) tell(form, "The service does not answer; nothing was stored.");
  }
  return null;
}

/** Let a form take what is dropped on it: `take` gets the entry (null where the browser has none) and the file. */
export function takesDrops(form, take) {
  form.addEventListener("dragover", (event) => {
    event.preventDefault();
    form.classList.add("over");
  });
  form.addEventListener("dragleave", () => form.classList.remove("over"));
  form.addEventListener("drop", async (event) => {
    event.preventDefault();
    form.classList.remove("over");
    const entry = event.dataTransfer.items[0]?.webkitGetAsEntry?.() ?? null;
    const file = event.dataTransfer.files[0];
    try {
      await take(entry, file);
    } catch (error) {
      tell(form, error.message);
    }
  });
}
