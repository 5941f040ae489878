// The text of the file beside the drawing, which may be edited as well: what is typed becomes a step of undo when it is TOML.

import {ask} from "./api.js";
import {make} from "./player/elements.js";

const PAUSE = 500;  // ms after the last key

export class SourcePanel {
  constructor(studio, element) {
    Object.assign(this, {studio, element, timer: null});
    this.area = make("textarea", {spellcheck: "false", wrap: "off", "aria-label": "text of the file"});
    this.note = make("p", {class: "note", role: "status"});
    this.area.addEventListener("input", () => {
      clearTimeout(this.timer);
      this.timer = setTimeout(() => this.take(), PAUSE);
      this.note.textContent = "";
    });
    this.area.addEventListener("blur", () => { if (this.timer) this.take(); });
    this.area.addEventListener("keydown", event => {
      if (event.key === "Escape") this.area.blur();
      event.stopPropagation();
    });
    element.append(this.area, this.note);
  }

  /** Show the text of the state, unless somebody is writing. */
  show() {
    const {text} = this.studio.state;
    if (text === null || text === undefined || this.timer || this.area.value === text) return;
    const {scrollTop, selectionStart, selectionEnd} = this.area;
    this.area.value = text;
    this.area.scrollTop = scrollTop;
    if (document.activeElement === this.area) this.area.setSelectionRange(selectionStart, selectionEnd);
    this.note.textContent = "";
  }

  /** Take what was typed, where it can be read. */
  async take() {
    clearTimeout(this.timer);
    const text = this.area.value;
    try {
      const found = await ask("compile", {text});
      if (this.area.value !== text) return undefined;
      this.timer = null;
      if (!found.document) return void (this.note.textContent = found.problems.join("\n"));
      if (text === this.studio.state.text) return undefined;
      const isNew = this.studio.commit(found.document, null, text);
      if (!isNew) Object.assign(this.studio.state, {text});  // a comment, or a space
      this.studio.files.showTitle();
    } catch (error) {
      this.timer = null;
      this.note.textContent = error.message;
    }
    return undefined;
  }
}
