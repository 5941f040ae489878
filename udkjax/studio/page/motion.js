// Time: the run of the drawing, playing and scrubbing it, and pulling the mechanism while its loops stay closed.

import {list, members, pinsOf, placeOf} from "./document.js";
import {middle} from "./drawn_symbols.js";
import {carry} from "./page_engine.js";
import {shown} from "./units.js";
import {icon} from "./player/elements.js";

const LONGEST_FRAME = 0.1;  // s: the motion advances by at most this much per frame

export class Motion {
  constructor(studio) {
    Object.assign(this, {studio, pageEngine: null, run: null, energies: null, t: 0, playing: false, posed: null, speed: 1, loop: true, why: ""});
    this.motions = new Float64Array(0);
  }

  get isMoved() { return this.t > 0 || this.playing || this.posed !== null; }
  get end() { return this.run?.count > 1 ? this.run.ts[this.run.count - 1] : 0; }

  /** Drop the motion: the drawing has none, or none yet. */
  forget() {
    this.pause();
    Object.assign(this, {pageEngine: null, run: null, energies: null, t: 0, posed: null, why: ""});
    this.studio.paths = [];
    this.studio.parts.loops.textContent = "";
    this.still();
    this.showTime();
  }

  showWaiting() { this.studio.parts.loops.textContent = "compiling the motion …"; }

  use(pageEngine, why) {
    Object.assign(this, {pageEngine, why});
    this.recompute();
    if (this.studio.isFresh) this.studio.fit();  // with the paths of its pins
    this.studio.isFresh = false;
    this.studio.curves.list();
    this.studio.redraw();
  }

  /** Compute the motion again after pins have moved in a drawing of the same structure. */
  follow(document) {
    if (!this.pageEngine?.engine || !this.pageEngine.follow(document)) return;
    if (Object.keys(pinsOf(document)).length !== this.pageEngine.pins.length) return;
    this.posed = null;
    this.recompute();
  }

  recompute() {
    this.run = this.pageEngine.run(this.posed);
    this.energies = this.pageEngine.energies(this.run);
    this.studio.paths = this.traces();
    if (!this.playing) this.still();
    this.showLoops();
  }

  /** Show the links as drawn. */
  still() { this.motions = new Float64Array(3 * list(this.studio.document, "link").length); }

  /** The paths of pins that move: [x, y, ...] in metres, and the link that carries each. */
  traces() {
    const {studio, run} = this, {document} = studio, found = [];
    if (run.count < 2) return found;
    const poses = Array.from({length: run.count}, (_, i) => this.pageEngine.motions(run.q.slice(i * this.pageEngine.size, (i + 1) * this.pageEngine.size)));
    for (const name of Object.keys(pinsOf(document))) {
      const link = studio.canvas.carrier(document, name), place = placeOf(document, name);
      if (link < 0 || !place || members(document, name).length < 1) continue;
      const line = new Float64Array(2 * poses.length);
      poses.forEach((motions, i) => line.set(carry(motions, link, place), 2 * i));
      found.push({name, link, line});
    }
    return found;
  }

  // Playing

  toggle() { if (this.playing) this.pause(); else this.play(); }

  play() {
    if (!this.run || this.end === 0) return this.studio.say(this.run?.words || "there is no motion to play yet", true);
    if (this.t >= this.end) this.t = 0;
    this.playing = true;
    let before = null;
    const frame = now => {
      if (!this.playing) return;
      const passed = before === null ? 0 : Math.min((now - before) / 1000, LONGEST_FRAME);
      before = now;
      let t = this.t + passed * this.speed;
      if (t >= this.end) t = this.loop ? t % this.end : this.end;
      this.seek(t);
      if (t >= this.end && !this.loop) return void this.pause();
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
    return this.showTime();
  }

  pause() {
    this.playing = false;
    this.showTime();
  }

  seek(t) {
    if (!this.run || !this.pageEngine) return;
    this.t = Math.min(Math.max(t, 0), this.end);
    const state = this.pageEngine.at(this.run, this.t);
    if (this.t > 0 || this.posed) this.motions = this.pageEngine.motions(state.q); else this.still();
    this.studio.redraw();
  }

  /** Return to the drawn position. */
  rewind() {
    this.pause();
    const wasPosed = this.posed !== null;
    if (wasPosed) this.studio.say("");
    Object.assign(this, {t: 0, posed: null});
    this.studio.hand = null;
    this.still();
    if (wasPosed && this.pageEngine) this.recompute();
    this.studio.redraw();
  }

  /** Show a closed position; without motors the motion starts from it. */
  pose(q) {
    this.pause();
    this.posed = {t: 0, q, v: new Float64Array(this.pageEngine.size), closed: true, violation: 0};
    this.release();
  }

  // Pulling

  beginPull(item, at) {
    this.pause();
    const {document} = this.studio, link = item.kind === "link" ? item.index : this.studio.canvas.carrier(document, item.name);
    const state = this.posed ?? (this.run && this.end ? this.pageEngine.at(this.run, this.t) : this.pageEngine.start());
    const from = this.pageEngine.motions(state.q), place = item.kind === "pin" ? placeOf(document, item.name) : undoMotion(from, link, at);
    Object.assign(this, {pulled: {link, place: place ?? middle(list(document, "link")[link], document)}, posed: {...state, t: 0}});
    this.pullTo(at);
  }

  pullTo(hand) {
    if (!this.pulled) return;
    const {link, place} = this.pulled, found = this.pageEngine.pull(this.posed, link, place, hand);
    this.posed = {t: 0, q: found.q, v: new Float64Array(this.pageEngine.size), closed: true, violation: found.violation};
    this.motions = this.pageEngine.motions(found.q);
    this.studio.hand = {at: carry(this.motions, link, place), to: hand};
    this.studio.say(found.words || "pulled: press Home to return to the drawn position");
    this.showLoops(found.violation);
    this.studio.redraw();
  }

  /** Let go. Without motors the motion starts from here; with motors it returns to its course when played. */
  endPull() {
    if (!this.pulled) return;
    this.pulled = null;
    this.studio.hand = null;
    this.release();
  }

  /** Compute the motion from the position shown, unless motors drive it. */
  release() {
    if (!this.pageEngine.scene.drivers.length) {
      this.t = 0;
      this.run = this.pageEngine.run(this.posed);
      this.energies = this.pageEngine.energies(this.run);
      this.studio.paths = this.traces();
      this.showLoops();
    }
    this.motions = this.pageEngine.motions(this.posed.q);
    this.studio.redraw();
  }

  // Display

  showLoops(violation = null) {
    const {run, pageEngine, studio} = this;
    if (!pageEngine) return;
    const worst = violation ?? Math.max(0, ...Array.from(run.violation.slice(0, run.count)));
    const closed = Number.isFinite(worst) ? `loops closed to ${worst.toExponential(0)}` : "loops not closed";
    const words = run.done ? "" : ` – ${run.words || "the motion ends"}${run.count > 1 ? ` at ${shown(this.end, "s")}` : ""}`;
    studio.parts.loops.textContent = pageEngine.engine ? closed + words : `recorded motion: ${this.why || "this browser has no WebAssembly"}${words}`;
    studio.parts.loops.classList.toggle("bad", !run.done);
  }

  showTime() {
    const {studio, t, end, playing} = this, {parts} = studio;
    parts.play.replaceChildren(icon(playing ? "pause" : "play"));
    parts.play.setAttribute("aria-label", playing ? "pause (space)" : "play (space)");
    parts.play.disabled = end === 0;
    parts.scrub.disabled = end === 0;
    parts.scrub.value = end > 0 ? Math.round(10000 * t / end) : 0;
    parts.time.textContent = end > 0 ? `${t.toFixed(2)} / ${end.toFixed(2)} s` : "0 s";
    parts.home.disabled = !this.isMoved;
  }
}

/** The drawn place that a motion brings to [x, y]. */
function undoMotion(motions, k, [x, y]) {
  const c = Math.cos(motions[3 * k + 2]), s = Math.sin(motions[3 * k + 2]), dx = x - motions[3 * k], dy = y - motions[3 * k + 1];
  return [c * dx + s * dy, c * dy - s * dx];
}
