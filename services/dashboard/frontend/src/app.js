// What every page needs: htmx with server-sent events, relative times that keep counting, confirmations.

import "./htmx.js";
import "htmx.org/dist/ext/hx-sse.js";

const STEPS = [
  [60, 1, "s"],
  [3600, 60, "min"],
  [86400, 3600, "h"],
  [86400 * 30, 86400, "d"],
];

/** Words for an age in seconds; the twin of `ago` in services/dashboard/text.py. */
function ago(seconds) {
  if (seconds < 2) return "just now";
  for (const [limit, unit, name] of STEPS) {
    if (seconds < limit) return `${Math.floor(seconds / unit)} ${name} ago`;
  }
  return null;
}

/** Words for a duration in seconds; the twin of `duration` there. */
function duration(seconds) {
  if (seconds < 9.95) return `${seconds.toFixed(1)} s`;
  const whole = Math.round(seconds);
  const two = (number) => String(number).padStart(2, "0");
  if (whole < 60) return `${whole} s`;
  if (whole < 3600) return `${Math.floor(whole / 60)} min ${two(whole % 60)} s`;
  return `${Math.floor(whole / 3600)} h ${two(Math.floor((whole % 3600) / 60))} min`;
}

function age(element) {
  return Math.max(0, (Date.now() - Date.parse(element.dateTime)) / 1000);
}

function write(element, words) {
  if (words !== null && element.textContent !== words) element.textContent = words;
}

function refreshTimes() {
  for (const element of document.querySelectorAll("time[data-ago]")) write(element, ago(age(element)));
  for (const element of document.querySelectorAll("time[data-since]")) write(element, duration(age(element)));
}

setInterval(refreshTimes, 1000);
document.addEventListener("htmx:after:swap", refreshTimes);
document.addEventListener("submit", (event) => {
  const question = event.target.dataset.confirm;
  if (question && !window.confirm(question)) event.preventDefault();
});
// A session that ended answers a live stream with 401: loading the page again leads to the login form.
document.addEventListener("htmx:sse:error", (event) => {
  if (event.detail?.status === 401) location.reload();
});
refreshTimes();
