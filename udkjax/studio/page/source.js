// The text of the file beside the drawing, which may be edited as well: what is typed becomes a step of undo when it is TOML.

import {ask} from "./api.js";
import {shapeProblem} from "./checks.js";
import {make} from "./player/elements.js";

const PAUSE = 500;  // ms after the last key

export class SourcePanel {
  constructor(studio, element) {
    Object.assign(this, {studio, element, timer: null, broken: null});  // the state beside which a text stands that cannot be read
    this.area = make("textarea", {spellcheck: "false", wrap: "off", "aria-label": "text of the file"});
    this.note = make("p", {class: "note", role: "status"});
    this.area.addEventListener("input", () => {
      clearTimeout(this.timer);
      this.timer = setTimeout(() => this.take(), PAUSE);
      this.say("");
    });
    this.area.addEventListener("blur", () => { if (this.timer) this.take(); });
    this.area.addEventListener("keydown", event => {
      if (event.key === "Escape") this.area.blur();
    });
    element.append(this.area, this.note);
  }

  /** Whether the text beside the drawing as it is cannot be read. */
  get isBroken() { return this.broken === this.studio.state; }

  say(words, ...buttons) {
    this.note.replaceChildren(words, ...buttons.map(([title, action]) => make("button", {type: "button", class: "small", onclick: action}, title)));
  }

  /** Put a text into the area, as if it were typed. */
  put(text) {
    this.area.value = text;
    return this.take();
  }

  /** Show the text of the state, unless somebody is writing. A text that could not be read can be had back. */
  show() {
    const {text} = this.studio.state;
    if (text === null || text === undefined || this.timer || this.area.value === text || this.isBroken) return;
    const {scrollTop, selectionStart, selectionEnd, value} = this.area, {broken} = this;
    this.area.value = text;
    this.area.scrollTop = scrollTop;
    if (document.activeElement === this.area) this.area.setSelectionRange(selectionStart, selectionEnd);
    this.broken = null;
    if (broken) this.say("The drawing has changed, and this is its text; what was typed is not in it. ", ["Bring it back", () => this.put(value)]);
    else this.say("");
  }

  /** Take what was typed, where it can be read. */
  async take() {
    clearTimeout(this.timer);
    const text = this.area.value, {state} = this.studio;
    try {
      const found = text === state.text ? {document: state.document} : await ask("compile", {text});
      if (this.area.value !== text) return undefined;
      this.timer = null;
      const problems = found.document ? [shapeProblem(found.document)].filter(Boolean) : found.problems;
      this.broken = !problems.length && this.studio.state === state ? null : state;
      if (this.studio.state !== state) return void this.show();  // drawn meanwhile
      if (this.broken) return void this.say(`${problems.join("\n")}\n`, ["Back to the text of the drawing", () => this.put(this.studio.state.text ?? "")]);
      this.say("");
      if (text === state.text) return undefined;
      const isNew = this.studio.commit(found.document, null, text);
      if (!isNew) Object.assign(this.studio.state, {text});  // a comment, or a space
      this.studio.files.showTitle();
    } catch (error) {
      this.timer = null;
      this.say(error.message);
    }
    return undefined;
  }
}
