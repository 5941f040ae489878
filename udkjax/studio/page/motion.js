// Time: the run of the drawing, playing and scrubbing it, and the hand that pulls the mechanism while its loops stay closed.

import {list, members, pinsOf, placeOf} from "./document.js";
import {middle} from "./drawn_symbols.js";
import {carry} from "./mover.js";
import {shown} from "./units.js";
import {icon} from "./player/elements.js";

const LONGEST_FRAME = 0.1;  // s that the motion goes on in one frame

export class Motion {
  constructor(studio) {
    Object.assign(this, {studio, mover: null, run: null, energies: null, t: 0, playing: false, posed: null, speed: 1, loop: true, why: ""});
    this.motions = new Float64Array(0);
  }

  get isMoved() { return this.t > 0 || this.playing || this.posed !== null; }
  get end() { return this.run?.count > 1 ? this.run.ts[this.run.count - 1] : 0; }

  /** There is no motion of this drawing, or not yet. */
  forget() {
    this.pause();
    Object.assign(this, {mover: null, run: null, energies: null, t: 0, posed: null, why: ""});
    this.studio.paths = [];
    this.studio.parts.loops.textContent = "";
    this.still();
    this.showTime();
  }

  showWaiting() { this.studio.parts.loops.textContent = "compiling the motion …"; }

  use(mover, why) {
    Object.assign(this, {mover, why});
    this.again();
    if (this.studio.isFresh) this.studio.fit();  // with the paths of its pins
    this.studio.isFresh = false;
    this.studio.curves.list();
    this.studio.redraw();
  }

  /** Pins of a drawing of the same structure have moved: run it anew. */
  follow(document) {
    if (!this.mover?.engine || !this.mover.follow(document)) return;
    if (Object.keys(pinsOf(document)).length !== this.mover.pins.length) return;
    this.posed = null;
    this.again();
  }

  again() {
    this.run = this.mover.run(this.posed);
    this.energies = this.mover.energies(this.run);
    this.studio.paths = this.traces();
    if (!this.playing) this.still();
    this.showLoops();
  }

  /** The links stand as drawn. */
  still() { this.motions = new Float64Array(3 * list(this.studio.document, "link").length); }

  /** The paths of pins that move: [x, y, ...] in metres, and the link that carries each. */
  traces() {
    const {studio, run} = this, {document} = studio, found = [];
    if (run.count < 2) return found;
    const poses = Array.from({length: run.count}, (_, i) => this.mover.motions(run.q.slice(i * this.mover.size, (i + 1) * this.mover.size)));
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
    if (!this.run || !this.mover) return;
    this.t = Math.min(Math.max(t, 0), this.end);
    const state = this.mover.at(this.run, this.t);
    if (this.t > 0 || this.posed) this.motions = this.mover.motions(state.q); else this.still();
    this.studio.redraw();
  }

  /** Back to the drawing. */
  rewind() {
    this.pause();
    const wasPosed = this.posed !== null;
    if (wasPosed) this.studio.say("");
    Object.assign(this, {t: 0, posed: null});
    this.studio.hand = null;
    this.still();
    if (wasPosed && this.mover) this.again();
    this.studio.redraw();
  }

  /** Show a closed position; what nothing drives starts from there. */
  pose(q) {
    this.pause();
    this.posed = {t: 0, q, v: new Float64Array(this.mover.size), closed: true, violation: 0};
    this.release();
  }

  // Pulling

  beginPull(item, at) {
    this.pause();
    const {document} = this.studio, link = item.kind === "link" ? item.index : this.studio.canvas.carrier(document, item.name);
    const state = this.posed ?? (this.run && this.end ? this.mover.at(this.run, this.t) : this.mover.start());
    const from = this.mover.motions(state.q), place = item.kind === "pin" ? placeOf(document, item.name) : undoMotion(from, link, at);
    Object.assign(this, {pulled: {link, place: place ?? middle(list(document, "link")[link], document)}, posed: {...state, t: 0}});
    this.pullTo(at);
  }

  pullTo(hand) {
    if (!this.pulled) return;
    const {link, place} = this.pulled, found = this.mover.pull(this.posed, link, place, hand);
    this.posed = {t: 0, q: found.q, v: new Float64Array(this.mover.size), closed: true, violation: found.violation};
    this.motions = this.mover.motions(found.q);
    this.studio.hand = {at: carry(this.motions, link, place), to: hand};
    this.studio.say(found.words || "pulled: Home returns to the drawing");
    this.showLoops(found.violation);
    this.studio.redraw();
  }

  /** Let go: what nothing drives starts from here; what a motor drives goes back when it is played. */
  endPull() {
    if (!this.pulled) return;
    this.pulled = null;
    this.studio.hand = null;
    this.release();
  }

  /** The motion from where it is shown, unless motors drive it. */
  release() {
    if (!this.mover.scene.drivers.length) {
      this.t = 0;
      this.run = this.mover.run(this.posed);
      this.energies = this.mover.energies(this.run);
      this.studio.paths = this.traces();
      this.showLoops();
    }
    this.motions = this.mover.motions(this.posed.q);
    this.studio.redraw();
  }

  // What is shown

  showLoops(violation = null) {
    const {run, mover, studio} = this;
    if (!mover) return;
    const worst = violation ?? Math.max(0, ...Array.from(run.violation.slice(0, run.count)));
    const closed = Number.isFinite(worst) ? `loops closed to ${worst.toExponential(0)}` : "loops open";
    const words = run.done ? "" : ` – ${run.words || "the motion ends"}${run.count > 1 ? ` at ${shown(this.end, "s")}` : ""}`;
    studio.parts.loops.textContent = mover.engine ? closed + words : `recorded motion: ${this.why || "this browser has no WebAssembly"}${words}`;
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

/** The place of the drawing that a motion brings to p. */
function undoMotion(motions, k, [x, y]) {
  const c = Math.cos(motions[3 * k + 2]), s = Math.sin(motions[3 * k + 2]), dx = x - motions[3 * k], dy = y - motions[3 * k + 1];
  return [c * dx + s * dy, c * dy - s * dx];
}
