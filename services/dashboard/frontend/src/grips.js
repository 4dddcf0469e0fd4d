// Boxes of which grips hold, where the version has models for more than one set of them: { type: "open", grips: [1] }.

export class Grips {
  /** @param {HTMLElement} box that is filled; @param {Function} changed is given the numbers of the grips that are open. */
  constructor(box, changed) {
    this.box = box;
    this.changed = changed;
    this.boxes = [];
  }

  /** A new session of so many grips, of which these sets can hold; at its start all do. */
  offer(count, sets) {
    this.sets = sets.map((one) => one.join());
    this.box.hidden = sets.length < 2;
    this.boxes = this.box.hidden ? [] : Array.from({ length: count }, (_, grip) => this.made(grip));
    this.box.replaceChildren(...this.boxes.map((input) => input.parentElement));
    this.reset();
  }

  made(grip) {
    const label = document.createElement("label");
    const input = Object.assign(document.createElement("input"), { type: "checkbox", name: `grip-${grip}` });
    input.addEventListener("change", () => {
      this.allow();
      this.changed(this.numbers(false));
    });
    label.append(input, `Grip ${grip + 1} holds`);
    return input;
  }

  /** All that can hold do, as after the start of a session. */
  reset() {
    for (const input of this.boxes) input.checked = true;
    this.allow();
  }

  numbers(holding) {
    return this.boxes.flatMap((input, grip) => (input.checked === holding ? [grip] : []));
  }

  /** Only what leads to a set that can hold may be changed. */
  allow() {
    for (const [grip, input] of this.boxes.entries()) {
      const then = this.boxes.flatMap((other, at) => (other.checked !== (at === grip) ? [at] : []));
      input.disabled = !this.sets.includes(then.join());
    }
  }
}
