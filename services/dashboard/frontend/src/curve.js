// Plots of a page. They are drawn by the server as SVG; a `<div data-curve="URL">` is filled with the one found there.
// Below each plot stand the numbers under the pointer. With `data-follow` a `frame` event of the page's 3D view moves
// the plot's playhead, and a click on the plot seeks in the view.

function number(value) {
  return value == null ? "–" : Number(value).toPrecision(3);
}

/** Time at a place of the picture, in the picture's own units along its time axis; null beside it. */
function timeAt(chart, clientX) {
  const [from, to] = chart.dataset.time.split(" ").map(Number);
  const [left, right] = chart.dataset.span.split(" ").map(Number);
  const box = chart.getBoundingClientRect();
  const x = ((clientX - box.left) / box.width) * chart.viewBox.baseVal.width;
  const share = (x - left) / (right - left);
  return share < 0 || share > 1 ? null : from + share * (to - from);
}

function moveTo(chart, time) {
  const [from, to] = chart.dataset.time.split(" ").map(Number);
  const [left, right] = chart.dataset.span.split(" ").map(Number);
  const line = chart.querySelector(".playhead");
  const inside = time !== null && time >= from && time <= to;
  line.style.display = inside ? "inline" : "none";
  if (!inside) return;
  const x = left + ((time - from) / (to - from || 1)) * (right - left);
  line.setAttribute("x1", x);
  line.setAttribute("x2", x);
}

/** Numbers of the lines at the time that is nearest to the pointer, in the figure's last line. */
function tellNumbers(figure, charts) {
  const times = JSON.parse(figure.dataset.x);
  const series = JSON.parse(figure.dataset.series);
  const told = document.createElement("output");
  told.className = "numbers quiet small";
  figure.append(told);
  const tell = (chart) => (event) => {
    const time = timeAt(chart, event.clientX);
    if (time === null) return;
    const nearest = times.reduce((best, value, k) => (Math.abs(value - time) < Math.abs(times[best] - time) ? k : best), 0);
    const values = series.map((one) => `${one.label} ${number(one.values[nearest])}`);
    told.textContent = `${number(times[nearest])}: ${values.join(", ")} ${figure.dataset.unit}`;
  };
  for (const chart of charts) chart.addEventListener("pointermove", tell(chart));
}

function wire(element) {
  const follows = element.dataset.follow !== undefined;
  for (const figure of element.querySelectorAll("figure.plot")) {
    const charts = figure.querySelectorAll("svg[data-time]"); // one for wide windows, one for narrow ones
    if (figure.dataset.series) tellNumbers(figure, charts); // a map of residuals has none
    if (!follows) continue;
    for (const chart of charts) {
      chart.classList.add("seeks");
      chart.addEventListener("click", (event) => {
        const time = timeAt(chart, event.clientX);
        if (time !== null) document.dispatchEvent(new CustomEvent("seek", { detail: time }));
      });
      document.addEventListener("frame", (event) => moveTo(chart, event.detail));
    }
  }
  element.dataset.ready = "true";
}

async function mount(element) {
  if (element.dataset.curve !== undefined) {
    const response = await fetch(element.dataset.curve);
    if (!response.ok) {
      element.textContent = `The curve could not be loaded (${response.status}).`;
      return;
    }
    element.innerHTML = await response.text();
  }
  wire(element);
}

for (const element of document.querySelectorAll(".curve")) mount(element);
