// The panel of a live page: sliders in sections, a message about the motion, and buttons.

import {make} from "./elements.js";

const STEPS = 500;  // key presses over the range of a slider
const DIGITS = 5;  // significant digits of a number

/** The panel of sliders and buttons; `changed(k, value)` is called while slider k moves, and an action when its button is pressed. */
export class SliderPanel {
  constructor(sliders, changed, actions) {
    this.sliders = sliders;
    this.rows = sliders.map((slider, k) => this.row(slider, value => changed(k, value)));
    this.note = make("p", {class: "note", role: "status"});
    const sections = Map.groupBy ? Map.groupBy(this.rows, r => r.slider.section) : grouped(this.rows);
    const parts = [...sections].map(([title, rows], k) => {
      const part = make("details", {}, make("summary", {}, title), ...rows.map(r => r.element));
      part.open = k < 1 || sections.size < 3 || this.rows.length < 9;
      return part;
    });
    this.buttons = Object.fromEntries(Object.entries(actions).map(([name, {words, title, act}]) => [name,
      make("button", {type: "button", title, onclick: act}, words)]));
    this.element = make("aside", {class: "live", "aria-label": "numbers of the scene"},
      make("div", {class: "actions"}, ...Object.values(this.buttons)), this.note, make("div", {class: "rows"}, ...parts));
  }

  row(slider, changed) {
    const {label, low, high, shown: unit = slider.unit, per_unit: per = 1} = slider, step = (high - low) / STEPS;
    const range = make("input", {type: "range", min: low, max: high, step, "aria-label": label, "aria-valuetext": `${slider.value * per} ${unit}`});
    const number = make("input", {type: "number", step: "any", "aria-label": `${label}, number`});
    const set = value => {
      if (value < +range.min) range.min = value;
      if (value > +range.max) range.max = value;
      range.value = value;
      number.value = +(value * per).toPrecision(DIGITS);
      range.setAttribute("aria-valuetext", `${number.value} ${unit}`);
    };
    range.addEventListener("input", () => { set(+range.value); changed(+range.value); });
    let taken = null;  // the last text that was taken
    const take = () => {
      if (!Number.isFinite(number.valueAsNumber)) return set(+range.value);
      if (number.value === taken) return undefined;
      const value = number.valueAsNumber / per;
      set(value);
      taken = number.value;
      return changed(value);
    };
    number.addEventListener("focus", () => { taken = number.value; });
    number.addEventListener("change", take);
    number.addEventListener("keydown", event => { if (event.key === "Enter") take(); });  // a notebook keeps Enter from causing a change event
    range.addEventListener("dblclick", () => { set(slider.value); changed(slider.value); });
    const words = unit.replaceAll("m2", "m²").replaceAll("s2", "s²").replaceAll("m3", "m³").replaceAll(" ", "·");
    const element = make("div", {class: "slider", title: slider.name},
      make("span", {class: "name"}, label), number, make("span", {class: "unit"}, words), range);
    set(slider.value);
    return {slider, element, set, range, number};
  }

  show(values) {
    values.forEach((value, k) => this.rows[k].set(value));
  }

  say(words, bad = false) {
    this.note.textContent = words;
    this.note.classList.toggle("bad", bad);
  }

  enable(on) {
    for (const input of this.element.querySelectorAll("input, button")) input.disabled = !on;
  }
}

function grouped(rows) {
  const found = new Map();
  for (const row of rows) found.set(row.slider.section, [...(found.get(row.slider.section) ?? []), row]);
  return found;
}

export const LIVE_STYLE = `
.middle { display: flex; min-height: 0; }
.fill .middle { flex: 1; }
.middle .stage { flex: 1; min-width: 0; }
.live { width: 300px; flex: none; display: flex; flex-direction: column; min-height: 0; background: var(--panel);
  border-left: 1px solid var(--line); font-size: 13px; }
.live .actions { display: flex; gap: 4px; flex-wrap: wrap; padding: 6px 10px; border-bottom: 1px solid var(--line); }
.live .note { margin: 0; padding: 7px 14px; color: var(--soft); min-height: 34px; white-space: pre-line; border-bottom: 1px solid var(--line); }
.live .note.bad { color: var(--force); font-weight: 600; }
.live .rows { overflow: auto; flex: 1; min-height: 0; padding: 4px 14px 14px; }
.live summary { cursor: pointer; font-weight: 600; padding: 8px 0 4px; }
.live .slider { display: grid; grid-template-columns: minmax(0, 1fr) 84px 48px; align-items: center; gap: 0 6px; padding: 4px 0 2px; }
.live .name { overflow-wrap: anywhere; }
.live .unit { color: var(--soft); }
.live .slider input[type="range"] { grid-column: 1 / -1; width: 100%; height: 24px; }
.live input[type="number"] { font: inherit; font-variant-numeric: tabular-nums; width: 100%; height: 26px; padding: 0 4px; text-align: right;
  color: var(--ink); background: var(--back); border: 1px solid var(--line); border-radius: 5px; appearance: textfield; }
.live input::-webkit-inner-spin-button { appearance: none; margin: 0; }
.live :disabled { opacity: 0.5; cursor: default; }
.narrow .middle { flex-direction: column; }
.narrow .live { width: auto; border-left: 0; border-top: 1px solid var(--line); max-height: 40%; }
.fill.narrow .live { flex: 0 1 38%; }
.panel canvas.holds { cursor: pointer; }
@media (pointer: coarse) { .live .slider input[type="range"] { height: 34px; } .live input[type="number"] { height: 34px; } }
`;
