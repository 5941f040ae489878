// Files: new, open, save, export. A file that has changed on disk is never overwritten without asking.

import {ask} from "./api.js";
import {shapeProblem} from "./checks.js";
import {EMPTY} from "./document.js";
import {addressField} from "./sharing.js";
import {make} from "./player/elements.js";

const EXPORTS = {html: "live page, simulates offline", svg: "vector picture", png: "bitmap picture", gif: "animated picture", mp4: "film", dxf: "drawing for CAD",
  csv: "table of the motion", py: "Python script"};

export class FileActions {
  constructor(studio) {
    Object.assign(this, {studio, path: "", revision: null, saved: {document: EMPTY, text: ""}});
    window.addEventListener("beforeunload", event => { if (this.isChanged) event.preventDefault(); });
  }

  get isChanged() { return JSON.stringify(this.studio.state.document) !== JSON.stringify(this.saved.document) || (this.studio.state.text !== null && this.studio.state.text !== this.saved.text); }

  showTitle() {
    const name = this.path || "untitled";
    this.studio.parts.title.textContent = (this.isChanged ? "● " : "") + name;
    this.studio.parts.title.title = this.isChanged ? `${name}: unsaved changes` : name;
    document.title = `${this.isChanged ? "● " : ""}${name} – udkjax studio`;
  }

  // Dialogs

  dialog(title, ...content) {
    const {dialog} = this.studio.parts;
    dialog.replaceChildren(make("h2", {}, title), ...content);
    if (!dialog.open) dialog.showModal();
    return dialog;
  }

  buttons(...entries) {
    const {dialog} = this.studio.parts;
    return make("div", {class: "group end"}, ...entries.map(([words, action, kind]) => make("button", {type: "button", class: kind ?? "", onclick: () => {
      dialog.close();
      action?.();
    }}, words)));
  }

  /** Run an action, after asking about unsaved changes. */
  unlessChanged(action) {
    if (!this.isChanged) return action();
    return this.dialog("Unsaved changes", make("p", {}, `${this.path || "This drawing"} has unsaved changes.`),
      this.buttons(["Cancel"], ["Discard changes", action], ["Save", async () => { if (await this.save(false)) action(); }, "strong"]));
  }

  fail(error) { this.studio.say(error.message, true); }

  // New and open

  showStart() {
    this.studio.findings.showEmpty();
    this.showTitle();
    this.studio.fit();
  }

  startNew() {
    this.unlessChanged(() => {
      Object.assign(this, {path: "", revision: null, saved: {document: EMPTY, text: ""}});
      this.studio.load({document: EMPTY, text: ""});
    });
  }

  showOpen() {
    this.unlessChanged(async () => {
      try {
        const {files, templates, folder} = await ask("list");
        const entry = (words, action) => make("li", {}, make("button", {type: "button", class: "link", onclick: () => { this.studio.parts.dialog.close(); action(); }}, words));
        this.dialog("Open",
          make("div", {class: "columns"},
            make("section", {}, make("h3", {}, `Files in ${folder}`), files.length ? make("ul", {}, ...files.map(name => entry(name, () => this.openFile(name)))) : make("p", {}, "no scene files yet")),
            make("section", {}, make("h3", {}, "Templates"), make("ul", {}, ...templates.map(({name, title}) => entry(title, () => this.openTemplate(name)))))),
          addressField(this.studio), this.buttons(["Cancel"]));
      } catch (error) { this.fail(error); }
    });
  }

  openFile(path, mayBeNew = false) {
    return this.open({path}, error => {
      if (!mayBeNew || error.status !== 404) return this.fail(error);
      Object.assign(this, {path, revision: null});
      this.showStart();
      return this.studio.say(`${path} does not exist yet: saving creates it`);
    });
  }

  openTemplate(template) { return this.open({template}, error => this.fail(error)); }

  openAddress(address) { return this.open({address}, error => this.fail(error)); }

  async open(request, failed) {
    const asked = request.path ?? request.template ?? "the shared drawing";
    this.studio.say(`opening ${asked} …`);
    try {
      const {text, document, path, revision, problems: said, drawn} = await ask("open", request);
      const problems = document ? [shapeProblem(document)].filter(Boolean) : said;
      if (!document || problems.length) {
        this.studio.say(problems.join("; "), true);
        this.dialog(`Cannot draw ${asked}`, make("ul", {class: "problems"}, ...problems.map(problem => make("li", {}, problem))), this.buttons(["Close"]));
        return;
      }
      Object.assign(this, {path: drawn ? "" : path, revision: drawn ? null : revision, saved: path && !drawn ? {document, text} : {document, text}});
      this.studio.load({document, text});
      this.studio.say(drawn && path ? `${path} is a scene of bodies and joints: it was converted into a drawing, which needs a new file name` : "");
    } catch (error) { failed(error); }
  }

  // Save and export

  async save(asNew) {
    if (!this.path || asNew) return this.askName("Save as", this.path || `${fileName(this.studio.document.name)}.toml`, path => this.write(path, path === this.path ? this.revision : null));
    return this.write(this.path, this.revision);
  }

  askName(title, suggested, action, ...content) {
    return new Promise(done => {
      const input = make("input", {type: "text", value: suggested, "aria-label": "file name", spellcheck: "false"});
      const form = make("form", {method: "dialog"}, ...content, make("label", {class: "field wide"}, make("span", {}, "file in this folder"), input),
        make("div", {class: "group end"}, make("button", {type: "button", onclick: () => { this.studio.parts.dialog.close(); done(false); }}, "Cancel"), make("button", {class: "strong"}, "Save")));
      form.addEventListener("submit", () => { if (input.value.trim()) done(action(input.value.trim())); else done(false); });
      this.dialog(title, form);
      this.nameInput = input;
      input.focus();
      input.setSelectionRange(0, Math.max(0, suggested.lastIndexOf(".")));
    });
  }

  /** The text of the current state, once it is known. */
  async text() {
    const {studio} = this;
    if (studio.source.timer) await studio.source.take();
    if (studio.source.isBroken) throw new Error("the edited text cannot be read: correct it, or go back to the text of the drawing");
    if (studio.state.text === null) {
      const found = await ask("compile", {text: studio.state.base ?? "", document: studio.state.document});
      Object.assign(studio.state, {text: found.text});
    }
    return studio.state.text;
  }

  async write(path, revision) {
    const name = path.endsWith(".toml") ? path : `${path}.toml`;
    try {
      const text = await this.text(), {document} = this.studio.state;
      const saved = await ask("save", {path: name, text, revision});
      Object.assign(this, {path: name, revision: saved.revision, saved: {document, text}});
      this.studio.say(`saved ${name}`);
      this.studio.source.show();
      this.showTitle();
      return true;
    } catch (error) {
      if (error.status === 409) return this.conflict(name, error);
      this.fail(error);
      return false;
    }
  }

  conflict(path, error) {
    return new Promise(done => {
      const {revision} = error.details;
      this.dialog("Changed on disk", make("p", {}, `${error.message}.`),
        this.buttons(["Cancel", () => done(false)], ["Open the file on disk", () => { this.openFile(path); done(false); }],
          ["Overwrite it", () => done(this.write(path, revision ?? null)), "strong"]));
    });
  }

  showExport() {
    const select = make("select", {"aria-label": "format"}, ...Object.entries(EXPORTS).map(([end, words]) => make("option", {value: end}, `.${end}: ${words}`)));
    select.addEventListener("change", () => { this.nameInput.value = this.nameInput.value.replace(/\.\w+$/, `.${select.value}`); });
    const base = (this.path || fileName(this.studio.document.name)).replace(/\.toml$/, "");
    return this.askName("Export", `${base}.html`, path => this.export(path, null), make("label", {class: "field wide"}, make("span", {}, "format"), select));
  }

  async export(path, revision) {
    this.studio.say(`exporting ${path} …`);
    try {
      const text = await this.text(), table = path.endsWith(".csv") ? this.studio.curves.table() : "";
      const {motion, answers} = this.studio, pose = motion.posed ? {q: Array.from(motion.posed.q)} : motion.t > 0 ? {t: motion.t} : {};
      const {bytes} = await ask("save", {path, text, revision, export: true, pose, gaps: answers.gaps.found !== null, ...(table && {table})});
      this.studio.say(`wrote ${path} (${Math.ceil(bytes / 1000)} kB)`);
      return true;
    } catch (error) {
      if (error.status !== 409) return void this.fail(error);
      return new Promise(done => {
        this.dialog("The file exists", make("p", {}, `${path} already exists.`), this.buttons(["Cancel", () => done(false)], ["Overwrite it", () => done(this.export(path, error.details.revision)), "strong"]));
      });
    }
  }
}

const fileName = name => (name ?? "").toLowerCase().replace(/[^a-z0-9]+/g, "_").replace(/^_+|_+$/g, "") || "drawing";
