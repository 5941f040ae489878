// The studio: one state, its changes, and the parts of the page that show it.

import {askedAddress, askedFile} from "./api.js";
import {DrawingCanvas} from "./canvas.js";
import {CurvesPanel} from "./curves.js";
import {DimensionMarks} from "./dimension_marks.js";
import {EMPTY, list, members, nameOf, pinsOf} from "./document.js";
import {PlaceEntry} from "./entry.js";
import {FileActions} from "./files.js";
import {AnswersPanel} from "./answers.js";
import {FindingsPanel} from "./findings.js";
import {Gestures} from "./gestures.js";
import {History} from "./history.js";
import {joinPin, loosePins} from "./joining.js";
import {followKeys} from "./keys.js";
import {buildPage, wear} from "./layout.js";
import {Motion} from "./motion.js";
import {Pictures} from "./pictures.js";
import {followPrinting} from "./print.js";
import {PropertiesPanel} from "./properties.js";
import {SourcePanel} from "./source.js";
import {Sync} from "./sync.js";
import {toolOf} from "./tools.js";
import {extentPoints} from "./shapes.js";
import {lengthUnit, niceBelow, tidy} from "./units.js";
import {fit} from "./view.js";
import {Vectors} from "./vectors.js";
import {WantedPath} from "./wanted.js";
import {make} from "./player/elements.js";

const NEW_SIZE = 0.25;  // m: width of the view of a new drawing
const SNAP_PIXELS = 8;  // least spacing of snapping points
const LINK_PIXELS = 26;  // width of a new link
const REACH = 9;  // px of a click on a link

const text = state => JSON.stringify(state.document);

class Studio {
  constructor(root) {
    this.history = new History({document: EMPTY, text: ""});
    Object.assign(this, {selection: [], hovered: null, tool: "select", preview: null, hand: null, marked: new Map(), paths: [], picture: null});
    this.show = {grid: true, names: true, paths: true, dimensions: true, snap: true};
    this.view = fit([], 800, 600, NEW_SIZE);
    this.proposed = null;
    this.media = matchMedia("(prefers-color-scheme: dark)");
    this.chosenTheme = null;
    this.parts = buildPage(this, root);
    this.canvas = new DrawingCanvas(this.parts.canvas);
    this.motion = new Motion(this);
    this.findings = new FindingsPanel(this, this.parts.findings);
    this.answers = new AnswersPanel(this, this.parts.answers);
    this.curves = new CurvesPanel(this, this.parts.strip);
    this.properties = new PropertiesPanel(this, this.parts.properties);
    this.source = new SourcePanel(this, this.parts.source);
    this.files = new FileActions(this);
    this.pictures = new Pictures(this, this.parts.picture);
    this.wanted = new WantedPath(this, this.parts.wanted);
    this.entry = new PlaceEntry(this, this.parts.entry);
    this.vectors = new Vectors(this);
    this.dimensions = new DimensionMarks(this, this.parts.dimension);
    this.sync = new Sync(this);
    this.gestures = new Gestures(this, this.parts.canvas);
    followKeys(this);
    followPrinting(this, root);
    this.media.addEventListener("change", () => this.retheme());
    new ResizeObserver(() => (this.isFitted ? this.fit() : this.redraw())).observe(this.parts.canvas);
    this.retheme();
    this.shown();
  }

  // The state

  get document() { return this.proposed ?? this.history.state.document; }
  get state() { return this.history.state; }
  get theme() { return this.chosenTheme ?? (this.media.matches ? "dark" : "light"); }
  get motions() { return this.motion.motions; }
  get isMoved() { return this.motion.isMoved; }

  /** Show another drawing, with a new history. */
  load(state) {
    this.proposed = null;
    this.history.reset(state);
    this.selection = [];
    this.motion.forget();
    this.gestures.cancel();
    this.isFresh = Object.keys(pinsOf(state.document)).length > 0;
    this.fit();
    this.changed();
  }

  /** Show a document while a gesture changes it; `commit` makes it an undo step. */
  propose(document) {
    this.proposed = document === this.history.state.document ? null : document;
    this.motion.follow(this.document);
    this.redraw();
  }

  /** Make a document the next state; returns whether it differs from the current one. `source` is its text, if known. */
  commit(document, select = null, source = null) {
    this.gestures.cancel();  // a gesture in progress belongs to the old drawing
    this.proposed = null;
    const base = this.state.text ?? this.state.base;
    const isNew = this.history.push({document, text: source, base}, (a, b) => text(a) === text(b));
    if (select) this.selection = select;
    if (isNew) this.changed(); else this.shown();
    return isNew;
  }

  /** Apply the result of a tool, or say why there is none. */
  apply({document, select, problem, measured}) {
    if (measured) return this.pictures.scale(...measured);
    if (problem) return this.say(problem);
    this.say("");
    this.commit(document, select);
    const loose = loosePins(document).find(({link}) => select?.some(item => item.kind === "link" && item.index === link));
    if (loose) this.say(`${loose.pin} lies on ${nameOf(document, "link", loose.link)}, but does not belong to it. `, false, ["Join them", () => this.join(loose)]);
    return undefined;
  }

  /** Join a pin to the link on which it lies. */
  join({pin, link}) {
    this.say("");
    this.commit(joinPin(this.document, pin, link), [{kind: "pin", name: pin}]);
  }

  undo() { this.travel(this.history.canUndo, () => this.history.undo()); }
  redo() { this.travel(this.history.canRedo, () => this.history.redo()); }

  travel(isPossible, step) {
    this.gestures.cancel();
    if (!isPossible) return;
    step();
    this.selection = this.selection.filter(item => (item.kind === "pin" ? item.name in pinsOf(this.document) : item.index < list(this.document, item.kind).length));
    this.changed();
  }

  /** The drawing has changed: show it, and update the server and the engine. */
  changed() {
    this.rewind();
    this.shown();
    this.sync.follow();
  }

  select(items) {
    this.selection = items;
    this.curves.follow();
    this.shown();
  }

  setTool(name) {
    this.gestures.cancel();
    this.parts.entry.hidden = true;
    this.tool = name;
    this.say(name === "select" ? "" : toolOf(name).title);
    this.shown();
  }

  /** Say something in the status line, with buttons [title, action]. */
  say(words, isBad = false, ...buttons) {
    this.parts.status.replaceChildren(words, ...buttons.map(([title, action]) => make("button", {type: "button", class: "small", onclick: action}, title)));
    this.parts.status.classList.toggle("bad", isBad);
  }

  showHelp() {
    this.parts.help.showModal();
    this.parts.help.scrollTop = 0;  // the focused button would scroll it down
  }

  // The view

  setView(view, isFitted = false) {
    Object.assign(this, {view, isFitted});
    this.redraw();
  }

  pan(dx, dy) { this.setView({...this.view, x: this.view.x + dx, y: this.view.y + dy}); }

  fit() {
    const places = extentPoints(this.document);
    for (const {line} of this.paths) for (let k = 0; k < line.length; k += 2) places.push([line[k], line[k + 1]]);
    places.push(...this.wanted?.points ?? []);
    const {width, height} = this.canvas;
    this.setView(fit(places, width || 800, height || 600, NEW_SIZE), true);
  }

  /** The spacing (m) of snapping points. */
  gridUnit() {
    const unit = lengthUnit(this.document);
    return unit * niceBelow(2 * SNAP_PIXELS / this.view.scale / unit);
  }

  /** A place on the grid, unless Alt is held. */
  snap(place, event) {
    if (!this.show.snap || event.altKey) return place;
    const unit = lengthUnit(this.document), step = this.gridUnit() / unit;
    return place.map(x => tidy(Math.round(x / unit / step) * step) * unit);
  }

  /** Sizes that suit the view, for tools: the width of a new link (m), pixels per metre, and the reach of a click (m). */
  get context() { return {size: LINK_PIXELS / this.view.scale, scale: this.view.scale, reach: REACH / this.view.scale}; }

  hover(item, preview) {
    const before = this.hovered;
    this.hovered = item;
    if (preview) this.preview = preview;
    this.parts.canvas.classList.toggle("over", Boolean(item));
    if (preview || before?.kind !== item?.kind || before?.name !== item?.name || before?.index !== item?.index) this.redraw();
  }

  retheme() {
    wear(document.documentElement, this.theme);
    this.redraw();
  }

  switchTheme() {
    this.chosenTheme = this.theme === "dark" ? "light" : "dark";
    this.retheme();
  }

  // Motion

  rewind() { this.motion.rewind(); }

  canPull(item) { return Boolean(this.motion.pageEngine?.engine) && (item.kind === "link" || (item.kind === "pin" && members(this.document, item.name).some(name => name !== "ground") && this.canvas.carrier(this.document, item.name) >= 0)); }

  // Display

  /** Update everything around the canvas, and redraw. */
  shown() {
    for (const button of this.parts.tools) button.setAttribute("aria-pressed", button.dataset.tool === this.tool);
    this.parts.canvas.dataset.tool = this.tool;
    this.parts.welcome.hidden = this.tool !== "select" || Object.keys(pinsOf(this.document)).length > 0 || Boolean(this.picture) || Boolean(this.wanted.points);
    this.parts.undo.disabled = !this.history.canUndo;
    this.parts.redo.disabled = !this.history.canRedo;
    this.properties.show();
    this.source.show();
    this.files.showTitle();
    this.redraw();
  }

  redraw() {
    this.frame ??= requestAnimationFrame(() => this.draw());
  }

  /** Draw pending changes at once, so that positions on the screen are current. */
  draw() {
    if (!this.frame) return;
    cancelAnimationFrame(this.frame);
    this.frame = null;
    this.canvas.draw(this);
    this.curves.draw();
    this.properties.showNow();
    this.motion.showTime();
  }
}

const studio = new Studio(document.getElementById("studio"));
window.studio = studio;
if (askedFile) studio.files.openFile(askedFile, true); else studio.files.showStart();
if (askedAddress) studio.files.openAddress(askedAddress);
