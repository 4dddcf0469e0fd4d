// Player of a film beside the recording that it is compared with: `<figure data-film>` holds two films of the same frames.
// One bar plays and seeks both. `data-view` of the figure is what is seen: "prediction", "recording", "overlay" (the
// prediction over the recording, as opaque as the slider says) or "beside". The prediction's film is the clock; the
// recording's follows it. Without this script the prediction plays alone, with the browser's own controls.

const MOST_DRIFT_FRAMES = { moving: 1.5, resting: 0.25 };

class FilmPlayer {
  constructor(figure) {
    const find = (name) => figure.querySelector(`[data-${name}]`);
    this.figure = figure;
    this.fps = Number(figure.dataset.fps);
    this.frames = Number(figure.dataset.frames);
    [this.clock, this.follower] = [find("prediction"), find("recording")];
    [this.button, this.place, this.told] = [find("play"), find("frame"), find("told")];
    [this.mix, this.share] = [find("mix"), find("share")];
    this.clock.controls = false;
    find("bar").hidden = false;
    for (const choice of figure.querySelectorAll("[data-choice]")) {
      choice.addEventListener("change", () => this.show(choice.value));
      if (choice.checked) this.show(choice.value);
    }
    this.button.addEventListener("click", () => (this.clock.paused ? this.play() : this.clock.pause()));
    this.place.addEventListener("input", () => this.seek(Number(this.place.value)));
    this.mix.addEventListener("input", () => this.blend());
    for (const event of ["play", "pause", "seeking", "seeked"]) this.clock.addEventListener(event, () => this.follow());
    this.follower.addEventListener("seeked", () => this.follow());
    find("whole").addEventListener("click", () => figure.requestFullscreen?.());
    this.follow();
    figure.dataset.ready = "true";
  }

  /** Which of both is seen; neither stops or moves. */
  show(view) {
    this.figure.dataset.view = view;
    this.mix.parentElement.hidden = view !== "overlay";
    this.blend();
  }

  blend() {
    const percent = Number(this.mix.value);
    this.share.textContent = `${percent} %`;
    this.clock.style.opacity = { recording: 0, overlay: percent / 100 }[this.figure.dataset.view] ?? 1;
  }

  async play() {
    await Promise.all([this.clock.play(), this.follower.play()]);
  }

  /** Both to the middle of a frame, so that rounding shows neither the one before nor the one after. */
  seek(frame) {
    this.clock.currentTime = this.follower.currentTime = (frame + 0.5) / this.fps;
    this.tell();
  }

  /** The recording to where the prediction is, playing or at rest as that is; again with every picture while it plays. */
  follow() {
    const { clock, follower } = this;
    this.button.textContent = clock.paused ? "Play" : "Pause";
    const drift = Math.abs(follower.currentTime - clock.currentTime) * this.fps;
    if (!follower.seeking && drift > MOST_DRIFT_FRAMES[clock.paused ? "resting" : "moving"]) follower.currentTime = clock.currentTime;
    if (clock.paused !== follower.paused) {
      if (clock.paused) follower.pause();
      else follower.play().catch(() => {}); // a pause came before it began
    }
    this.tell();
    if (!clock.paused && !this.waiting) {
      this.waiting = true;
      requestAnimationFrame(() => {
        this.waiting = false;
        this.follow();
      });
    }
  }

  tell() {
    const frame = Math.min(this.frames - 1, Math.floor(this.clock.currentTime * this.fps + 1e-6));
    const words = `frame ${frame + 1} of ${this.frames}, ${(frame / this.fps).toFixed(2)} s`;
    this.place.value = frame;
    this.place.setAttribute("aria-valuetext", words);
    if (this.told.textContent !== words) this.told.textContent = words;
  }
}

for (const figure of document.querySelectorAll("figure[data-film]")) new FilmPlayer(figure);
