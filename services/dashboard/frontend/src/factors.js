// Sliders of the body's properties, each a factor of the model's own: Φ, which the world model is given beside the motion.

const FARTHEST = 2; // doublings to either side: a quarter to four times

export class Factors {
  /** @param {HTMLElement} box that is filled; @param {Function} changed is given the factors by name. */
  constructor(box, changed) {
    this.box = box;
    this.changed = changed;
    this.values = {};
  }

  /** Offer the properties that a session has; what was chosen before stays chosen. */
  offer(names) {
    if (this.box.childElementCount === 0) for (const name of names) this.box.append(this.slider(name));
    this.box.hidden = names.length === 0;
    if (Object.values(this.values).some((value) => value !== 1)) this.changed(this.values);
  }

  slider(name) {
    const label = document.createElement("label");
    const input = Object.assign(document.createElement("input"), {
      type: "range", min: -FARTHEST, max: FARTHEST, step: 0.05, value: 0, name,
    });
    const told = document.createElement("output");
    const read = () => {
      this.values[name] = 2 ** Number(input.value);
      told.textContent = `× ${this.values[name].toPrecision(3)}`;
    };
    read();
    input.addEventListener("input", () => {
      read();
      this.changed(this.values);
    });
    label.append(name[0].toUpperCase() + name.slice(1), input, told);
    return label;
  }
}
