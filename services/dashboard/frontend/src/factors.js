// Sliders of what the world model is given beside the motion: properties of the body, each a factor of the model's own
// (Φ), and strengths of effects in their units, over the range that the training covered.

const FARTHEST = 2; // doublings to either side: a quarter to four times
const STEPS = 100; // of a strength's slider

export class Factors {
  /** @param {HTMLElement} box that is filled; @param {Function} changed is given factors and strengths by name. */
  constructor(box, changed) {
    this.box = box;
    this.changed = changed;
    this.factors = {};
    this.strengths = {};
    this.touched = false;
  }

  /** Offer the properties and strengths that a session has; what was chosen before stays chosen. */
  offer(names, strengths) {
    if (this.box.childElementCount === 0) {
      for (const name of names) this.box.append(this.factor(name));
      for (const strength of strengths) this.box.append(this.strength(strength));
    }
    this.box.hidden = names.length + strengths.length === 0;
    if (this.touched) this.tell();
  }

  /** Offer the strengths that act on the twin beside the model alone; none where there is no twin. */
  beside(strengths) {
    const own = new Set([...this.box.querySelectorAll("input:not([data-beside])")].map((input) => input.name));
    const offered = strengths.filter(({ name }) => !own.has(name));
    const names = offered.map(({ name }) => name).join();
    if (names === (this.offered ?? "")) return;
    this.offered = names;
    for (const input of this.box.querySelectorAll("input[data-beside]")) {
      delete this.strengths[input.name];
      input.parentElement.remove();
    }
    for (const strength of offered) {
      const made = this.strength({ ...strength, label: `${strength.label} (twin only)` });
      made.title = "The model was not trained over this strength: the slider acts on the twin beside it";
      made.querySelector("input").dataset.beside = "";
      this.box.append(made);
    }
    this.box.hidden = this.box.childElementCount === 0;
  }

  tell() {
    this.touched = true;
    this.changed(this.factors, this.strengths);
  }

  factor(name) {
    const range = { min: -FARTHEST, max: FARTHEST, step: 0.05, value: 0, name };
    return this.slider(capital(name), range, (value) => {
      this.factors[name] = 2 ** value;
      return `× ${this.factors[name].toPrecision(3)}`;
    });
  }

  strength({ name, label, unit, low, high, value }) {
    const share = (value - low) / (high - low); // a slider of 0 to STEPS: a step of the quantity may be no decimal number
    const range = { min: 0, max: STEPS, step: "any", value: STEPS * share, name };
    const made = this.slider(capital(label), range, (place) => {
      this.strengths[name] = low + ((high - low) * place) / STEPS;
      return `${+this.strengths[name].toPrecision(3)}${written(unit)}`;
    });
    made.title = `${+low.toPrecision(3)} to ${+high.toPrecision(3)}${written(unit)} are what the training covered`;
    return made;
  }

  /** A labelled slider; `read` takes its place and tells it in words. */
  slider(words, range, read) {
    const label = document.createElement("label");
    const input = Object.assign(document.createElement("input"), { type: "range" }, range);
    const told = document.createElement("output");
    const show = () => {
      told.textContent = read(Number(input.value));
      input.setAttribute("aria-valuetext", told.textContent);
    };
    show();
    input.addEventListener("input", () => {
      show();
      this.tell();
    });
    label.append(words, input, told);
    return label;
  }
}

function capital(words) {
  return words[0].toUpperCase() + words.slice(1);
}

function written(unit) {
  return unit === "1" || !unit ? "" : ` ${unit.replace("^2", "²").replace("^3", "³")}`;
}
