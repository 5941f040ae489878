// The player: its elements, their actions, and the drawing of a frame.

import {HELP, LIVE_HELP, SPEEDS, button, icon, keepKeys, make} from "./elements.js";
import {EventMarks} from "./event_marks.js";
import {GapMarks, paintTouching} from "./gap_marks.js";
import {Live} from "./live.js";
import {Run, clamp} from "./motion.js";
import {THEMES, contextOf} from "./painter.js";
import {followPointers} from "./pointers.js";
import {drawStrip, stripPart} from "./strip.js";
import {LIVE_STYLE} from "./sliders.js";
import {STYLE} from "./style.js";
import {SymbolPainter} from "./symbols.js";

export class Player {
  constructor(element, data, options) {
    if (data.format !== 1) throw new Error(`this player reads format 1, not ${data.format}`);
    this.data = data;
    this.options = options;
    this.runs = data.runs.map(record => new Run(record));
    this.modes = this.runs.some(run => run.mode);
    this.t = data.start;
    this.playing = false;
    this.speed = data.speed;
    this.amplitude = 1;
    this.show = {traces: !this.modes, names: false, reactions: this.runs.some(run => run.reactions), loop: true};
    this.zoom = {factor: 1, x: 0, y: 0};
    this.measures = [...new Set(this.runs.flatMap(run => run.measures.map(m => m.name)))];
    this.measure = this.measures[0];
    this.listeners = [];
    this.media = matchMedia("(prefers-color-scheme: dark)");
    this.chosen = options.theme ?? null;
    this.build(element);
    this.onMedia = () => this.retheme();
    this.media.addEventListener("change", this.onMedia);
    this.resize = new ResizeObserver(() => this.layout());
    this.resize.observe(this.root);
    this.retheme();
    this.layout();
    if (options.autoplay && !matchMedia("(prefers-reduced-motion: reduce)").matches) this.play();
  }

  build(element) {
    const {data} = this, shadow = element.shadowRoot ?? element.attachShadow({mode: "open"});
    const toggle = (name, words, key) => button(words, `${words} (${key})`, () => this.toggle(name));
    this.playButton = make("button", {class: "icon primary", type: "button", onclick: () => this.toggle("playing")});
    this.timeLabel = make("span", {class: "time"});
    this.scrub = make("input", {class: "scrub", type: "range", min: 0, max: 10000, step: 1, "aria-label": "time",
      oninput: () => this.seek(data.start + (data.end - data.start) * this.scrub.value / 10000)});
    this.speedSelect = make("select", {"aria-label": "speed", title: "speed (+ −)", onchange: () => this.setSpeed(+this.speedSelect.value)});
    const near = SPEEDS.filter(s => s >= 0.009 * this.speed && s <= 21 * this.speed);
    for (const s of [...new Set([...near, this.speed])].sort((a, b) => a - b)) {
      this.speedSelect.append(make("option", {value: s}, `${s} ×`));
    }
    this.speedSelect.value = this.speed;
    this.buttons = {loop: button(icon("loop"), "repeat (L)", () => this.toggle("loop"), "icon")};
    if (this.runs.some(run => run.traces.length)) this.buttons.traces = toggle("traces", "Traces", "T");
    if (this.runs.some(run => run.reactions)) this.buttons.reactions = toggle("reactions", "Reactions", "R");
    this.buttons.names = toggle("names", "Names", "N");
    this.gaps = this.runs.some(run => run.gaps) ? new GapMarks(this) : null;
    this.panels = this.runs.map((run, k) => this.panel(run, k));
    this.stage = make("div", {class: "stage"}, ...this.panels.map(p => p.figure));
    this.live = data.live ? new Live(this, data) : null;
    const middle = this.live ? make("div", {class: "middle"}, this.stage, this.live.panel.element) : this.stage;
    this.help = make("div", {class: "help", hidden: "", onclick: () => this.toggleHelp()},
      make("dl", {}, ...[...HELP, ...(data.live ? LIVE_HELP : []), ...(this.gaps ? [["G", "least gap"]] : [])].flatMap(([key, words]) => [make("dt", {}, key), make("dd", {}, words)])));
    this.eventMarks = new EventMarks(this);
    const groups = [this.playButton, this.timeLabel, this.eventMarks.element, make("div", {class: "group"}, ...(this.modes ? [] : [this.speedSelect]),
      ...Object.entries(this.buttons).filter(([name]) => name !== "ghost").map(([, button]) => button), ...(this.gaps ? [this.gaps.button] : []))];
    if (this.modes) {
      const range = make("input", {type: "range", min: 0, max: 3, step: 0.01, value: 1, "aria-label": "amplitude",
        oninput: () => { this.amplitude = +range.value; this.draw(); }});
      groups.push(make("label", {class: "amplitude"}, "amplitude", range));
    }
    this.root = make("div", {class: "player", tabindex: -1},
      make("header", {}, make("h1", {title: data.title}, data.title),
        button(icon("theme"), "switch between dark and light (D)", () => this.switchTheme(), "icon"),
        button("?", "keyboard shortcuts (?)", () => this.toggleHelp(), "icon")),
      middle, ...(this.measures.length ? [this.strip()] : []), make("div", {class: "controls"}, ...groups), this.help);
    this.keys = this.options.fill ? window : this.root;  // a filled window has no other use of keys
    this.onKey = event => this.key(event);
    this.keys.addEventListener("keydown", this.onKey);
    keepKeys(this.root, this.panels[0].canvas);
    this.root.classList.toggle("fill", Boolean(this.options.fill));
    shadow.replaceChildren(make("style", {}, STYLE + (data.live ? LIVE_STYLE : "")), this.root);
    for (const name of Object.keys(this.buttons)) this.press(name);
    this.setPlaying(false);
  }

  panel(run, k) {
    const canvas = make("canvas", {role: "img", tabindex: 0, "aria-label": `${this.data.title} ${run.label}: motion`});
    const note = make("span", {}, run.note ? ` ${run.note}` : ""), happened = make("div", {class: "happened"});
    const caption = make("figcaption", {}, ...(this.runs.length > 1 || this.modes ? [make("b", {}, run.label)] : []), note, happened);
    const panel = {run, canvas, note, happened, figure: make("figure", {class: "panel"}, canvas, caption)};
    followPointers(this, canvas, () => this.live?.runs[k]);
    return panel;
  }

  strip() {
    this.stripCanvas = make("canvas", {"aria-hidden": "true"});
    const select = this.measureSelect = make("select", {"aria-label": "measure", onchange: () => { this.measure = select.value; this.draw(); }});
    for (const name of this.measures) select.append(make("option", {value: name}, name));
    const seek = event => {
      const box = this.stripCanvas.getBoundingClientRect();
      this.seek(this.data.start + (this.data.end - this.data.start) * stripPart(event.clientX - box.left, box.width));
    };
    this.stripCanvas.addEventListener("pointerdown", event => { this.stripCanvas.setPointerCapture(event.pointerId); seek(event); });
    this.stripCanvas.addEventListener("pointermove", event => { if (event.buttons) seek(event); });
    return make("div", {class: "strip"}, this.stripCanvas, select);
  }

  zoomAt(canvas, x, y, factor) {
    const next = clamp(this.zoom.factor * factor, 0.2, 100), ratio = next / this.zoom.factor;
    const cx = canvas.clientWidth / 2, cy = canvas.clientHeight / 2;
    this.zoom.x = (this.zoom.x + cx - x) * ratio + x - cx;
    this.zoom.y = (this.zoom.y + cy - y) * ratio + y - cy;
    this.zoom.factor = next;
  }

  whole() {
    this.zoom = {factor: 1, x: 0, y: 0};
    this.live?.fit();
    this.draw();
  }

  // Actions

  on(listener) {
    this.listeners.push(listener);
  }

  notify() {
    for (const listener of this.listeners) listener(this);
  }

  toggle(name) {
    if (name === "playing") return this.playing ? this.pause() : this.play();
    this.show[name] = !this.show[name];
    this.press(name);
    this.draw();
  }

  press(name) {
    this.buttons[name]?.setAttribute("aria-pressed", this.show[name]);
  }

  setPlaying(playing) {
    this.playing = playing;
    const words = playing ? "pause (space)" : "play (space)";
    this.playButton.replaceChildren(icon(playing ? "pause" : "play"));
    this.playButton.title = words;
    this.playButton.setAttribute("aria-label", words);
  }

  setSpeed(speed) {
    this.speed = speed;
    this.speedSelect.value = speed;
  }

  play() {
    if (this.playing) return;
    if (this.t >= this.data.end) this.t = this.data.start;
    this.setPlaying(true);
    let before = null;
    const frame = now => {
      if (!this.playing) return;
      this.advance(before === null ? 0 : Math.min(now - before, 250) / 1000);
      before = now;
      this.request = requestAnimationFrame(frame);
    };
    this.request = requestAnimationFrame(frame);
    this.notify();
  }

  /** Set the end of the timeline. */
  setEnd(end) {
    this.data.end = end;
    this.t = Math.min(this.t, end);
  }

  advance(seconds) {
    const {start, end} = this.data;
    let t = this.t + seconds * this.speed;
    if (t >= end && this.show.loop && end > start) t = start + (t - start) % (end - start);
    this.t = Math.min(t, end);
    this.draw();
    if (this.t >= end) this.pause();
  }

  pause() {
    if (!this.playing) return;
    cancelAnimationFrame(this.request);
    this.setPlaying(false);
    this.notify();
  }

  seek(t) {
    this.t = clamp(t, this.data.start, this.data.end);
    this.draw();
    this.notify();
  }

  switchTheme() {
    this.chosen = this.themeName() === "dark" ? "light" : "dark";
    this.retheme();
  }

  themeName() {
    return this.chosen ?? (this.media.matches ? "dark" : "light");
  }

  retheme() {
    this.theme = THEMES[this.themeName()];
    const {back, panel, ink, soft, line, accent, onAccent, force} = this.theme;
    const colours = {back, panel, ink, soft, line, accent, force, "on-accent": onAccent};
    for (const [name, value] of Object.entries(colours)) this.root.style.setProperty(`--${name}`, value);
    this.root.style.colorScheme = this.themeName();
    if (this.options.fill) document.body.style.background = back;
    this.draw();
  }

  toggleHelp() {
    this.help.hidden = !this.help.hidden;
  }

  key(event) {
    const [target] = event.composedPath();
    if (event.ctrlKey || event.metaKey || event.altKey || ["SELECT", "INPUT"].includes(target.tagName) && target !== this.scrub) return;
    const {start, end} = this.data, step = event.shiftKey ? (end - start) / 20 : this.speed / 30;
    const speeds = [...this.speedSelect.options].map(o => +o.value), at = speeds.indexOf(this.speed);
    const actions = {
      " ": () => this.toggle("playing"), ArrowLeft: () => this.seek(this.t - step), ArrowRight: () => this.seek(this.t + step),
      Home: () => this.seek(start), End: () => this.seek(end), 0: () => this.whole(), "?": () => this.toggleHelp(),
      "+": () => this.setSpeed(speeds[Math.min(at + 1, speeds.length - 1)]), "-": () => this.setSpeed(speeds[Math.max(at - 1, 0)]),
      t: () => this.toggle("traces"), n: () => this.toggle("names"), r: () => this.toggle("reactions"), l: () => this.toggle("loop"),
      d: () => this.switchTheme(), ...(this.live?.keys() ?? {}), ...(this.gaps ? {g: this.gaps.show} : {}), Escape: () => { this.help.hidden = true; },
    };
    const action = actions[event.key] ?? actions[event.key.toLowerCase()];
    if (!action || (event.key === " " && ["BUTTON", "SUMMARY"].includes(target.tagName))) return;  // a button takes the space bar itself
    event.preventDefault();
    action();
  }

  // Drawing

  layout() {
    const width = this.root.clientWidth;
    if (!width) return;
    this.root.classList.toggle("narrow", width < 640);
    if (!this.options.fill) {
      const [left, bottom, right, top] = this.data.bounds, narrow = width < 640;
      const each = narrow ? width : width / this.runs.length, aspect = (top - bottom) / (right - left);
      const height = clamp(each * aspect + 60, 220, narrow ? 320 : 480);
      this.stage.style.height = `${Math.round(narrow ? height * this.runs.length : height)}px`;
    }
    this.draw();
  }

  /** The view of a panel: a place (X, Y) in metres is at the pixel (x + scale X, y - scale Y). */
  view(width, height) {
    const [left, bottom, right, top] = this.data.bounds;
    const margin = Math.min(44, 0.12 * Math.min(width, height));
    const fit = Math.min((width - 2 * margin) / (right - left), (height - 2 * margin) / (top - bottom));
    const scale = fit * this.zoom.factor;
    return {scale, x: width / 2 - scale * (left + right) / 2 + this.zoom.x, y: height / 2 + scale * (bottom + top) / 2 + this.zoom.y};
  }

  /** The painter of a panel's canvas. */
  painter(canvas, context = null) {
    const {clientWidth: width, clientHeight: height} = canvas, pt = clamp(Math.min(width, height) / 420, 0.75, 1.5);
    return new SymbolPainter(context, this.view(width, height), this.theme, pt, null);
  }

  draw() {
    if (!this.theme) return;
    const {data, t, theme, show} = this;
    this.panels.forEach(({run, canvas, note}, k) => {
      const live = this.live?.runs[k];
      note.hidden = Boolean(live?.changed);  // the note is about the first motion
      const {context, width, height} = contextOf(canvas);
      if (!width || !height) return;
      const painter = this.painter(canvas, context), step = painter.grid(width, height);
      live?.paintGhost(painter, context, t);
      if (show.traces && !run.mode) painter.traces(run, t);
      painter.pose = run.pose(t, this.amplitude);
      painter.draw(run.symbols);
      if (run.gaps) paintTouching(painter, run.gaps);
      painter.sticking(run, t);
      live?.paintHand(painter);
      if (show.reactions && run.reactions) painter.reactions(run, t, width, height);
      if (show.names) painter.names(run);
      painter.bar(step, height);
    });
    if (this.stripCanvas) {
      const {context, width, height} = contextOf(this.stripCanvas);
      drawStrip(context, width, height, this.runs, this.measure, data.start, data.end, t, theme, this.measureSelect.offsetWidth + 24);
    }
    this.eventMarks.draw();
    const span = data.end - data.start;
    this.scrub.value = span > 0 ? Math.round(10000 * (t - data.start) / span) : 0;
    const digits = clamp(3 - Math.floor(Math.log10(span || 1)), 0, 9), of = x => x.toFixed(digits);
    const [now, rest] = this.modes ? [`${Math.round(360 * t)}°`, ""] : [of(t), ` / ${of(data.end)} ${data.unit}`];
    this.timeLabel.replaceChildren(make("b", {}, now), rest);
    this.scrub.setAttribute("aria-valuetext", now + rest);
  }

  destroy() {
    this.pause();
    this.resize.disconnect();
    this.keys.removeEventListener("keydown", this.onKey);
    this.media.removeEventListener("change", this.onMedia);
    this.root.remove();
  }
}
