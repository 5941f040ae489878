// The text of the file, which can be edited like the drawing: an edit becomes an undo step once it can be read.

import {ask} from "./api.js";
import {shapeProblem} from "./checks.js";
import {make} from "./player/elements.js";

const PAUSE = 500;  // ms after the last key

export class SourcePanel {
  constructor(studio, element) {
    Object.assign(this, {studio, element, timer: null, broken: null});  // the state whose text was edited into something that cannot be read
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

  /** True while the edited text of the current state cannot be read. */
  get isBroken() { return this.broken === this.studio.state; }

  say(words, ...buttons) {
    this.note.replaceChildren(words, ...buttons.map(([title, action]) => make("button", {type: "button", class: "small", onclick: action}, title)));
  }

  /** Put a text into the area, as if it had been typed. */
  put(text) {
    this.area.value = text;
    return this.take();
  }

  /** Show the text of the state, unless the user is typing. A replaced text that could not be read can be restored. */
  show() {
    const {text} = this.studio.state;
    if (text === null || text === undefined || this.timer || this.area.value === text || this.isBroken) return;
    const {scrollTop, selectionStart, selectionEnd, value} = this.area, {broken} = this;
    this.area.value = text;
    this.area.scrollTop = scrollTop;
    if (document.activeElement === this.area) this.area.setSelectionRange(selectionStart, selectionEnd);
    this.broken = null;
    if (broken) this.say("The drawing has changed; this is its new text, without the edit that could not be read. ", ["Restore the edit", () => this.put(value)]);
    else this.say("");
  }

  /** Take the edited text, if it can be read. */
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
