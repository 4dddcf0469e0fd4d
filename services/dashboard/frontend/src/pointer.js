// What the pointer means on a view in space: which of the places drawn there, and whether a press was a click or a turn.

const CLICK_PX = 4; // that a click may move; more turns the view

export class Pointer {
  /**
   * `nearest` gets a function from a place to its distance from the pointer [px] and answers what is meant, or undefined;
   * `named` hears of that whenever the pointer moves, `clicked` when something is clicked.
   */
  constructor(canvas, view, { nearest, named, clicked }) {
    [this.canvas, this.view] = [canvas, view];
    let pressed;
    canvas.addEventListener("pointerdown", (event) => (pressed = [event.clientX, event.clientY]));
    canvas.addEventListener("pointermove", (event) => named(nearest(this.away(event))));
    canvas.addEventListener("pointerup", (event) => {
      if (!pressed || Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > CLICK_PX) return;
      const meant = nearest(this.away(event));
      if (meant !== undefined) clicked(meant);
    });
  }

  /** Where a place is drawn on the canvas [px]. */
  seenAt(place) {
    const { x, y } = place.clone().project(this.view.camera);
    return [((x + 1) / 2) * this.canvas.clientWidth, ((1 - y) / 2) * this.canvas.clientHeight];
  }

  away(event) {
    const { left, top } = this.canvas.getBoundingClientRect();
    return (place) => {
      const [x, y] = this.seenAt(place);
      return Math.hypot(x - (event.clientX - left), y - (event.clientY - top));
    };
  }
}
