// Time: the run of the drawing, playing and scrubbing it, and pulling the mechanism while its loops stay closed.

import {timeOfText} from "./along.js";
import {list, members, pinsOf, placeOf} from "./document.js";
import {middle} from "./drawn_symbols.js";
import {carry, carryBack} from "./motions.js";
import {shown} from "./units.js";
import {icon} from "./player/elements.js";

const LONGEST_FRAME = 0.1;  // s: the motion advances by at most this much per frame
const WAITED = 300;  // ms after which a computation is shown

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
    this.pageEngine?.close();
    Object.assign(this, {pageEngine: null, run: null, energies: null, t: 0, posed: null, why: "", pending: null});
    this.studio.paths = [];
    this.studio.parts.loops.textContent = "";
    this.showComputing(false);
    this.still();
    this.showTime();
  }

  showWaiting() { this.studio.parts.loops.textContent = "compiling the motion …"; }

  /** Use the engine of the current drawing, and wait for its first run. */
  use(pageEngine, why) {
    this.pageEngine?.close();
    Object.assign(this, {pageEngine, why, run: null, energies: null});
    if (pageEngine.runner) pageEngine.runner.onWait = waits => this.showComputing(waits);
    this.recompute();
    return this.settled();
  }

  /** Compute the motion again after pins have moved in a drawing of the same structure. */
  follow(document) {
    if (!this.pageEngine?.engine || !this.pageEngine.follow(document)) return;
    if (Object.keys(pinsOf(document)).length !== this.pageEngine.pins.length) return;
    this.posed = null;
    this.recompute();
  }

  /** Ask for the motion of the current drawing, or from the position shown; it is taken when it is there. */
  recompute() {
    const {pageEngine} = this;
    if (!this.playing) this.still();
    const asked = pageEngine.run(this.posed, this.carried()).then(run => { if (run && this.pageEngine === pageEngine) this.take(run); },
      error => { if (this.pageEngine === pageEngine) this.studio.say(error.message, true); });
    this.pending = asked;
  }

  /** Wait for the runs that have been asked for. */
  async settled() {
    for (let before = null; this.pending && before !== this.pending;) {
      before = this.pending;
      await before;
    }
  }

  take(run) {
    const {studio} = this;
    Object.assign(this, {run, energies: run.energies});
    studio.paths = run.paths;
    if (studio.isFresh && studio.isFitted) studio.fit();  // with the paths of its pins
    studio.isFresh = false;
    this.showLoops();
    studio.curves.list();
    this.showTime();
    studio.redraw();
  }

  /** Show that a run takes long, with a button that stops it. */
  showComputing(waits) {
    clearTimeout(this.shownLater);
    const {stop} = this.studio.parts;
    if (!waits) stop.hidden = true; else this.shownLater = setTimeout(() => { stop.hidden = false; }, WAITED);
  }

  /** Stop the run in hand. */
  stop() { this.pageEngine?.stop(); }

  /** Show the links as drawn. */
  still() { this.motions = new Float64Array(3 * list(this.studio.document, "link").length); }

  /** The pins that links carry, {name, link, place}. */
  carried() {
    const {studio: {document, canvas}} = this;
    return Object.keys(pinsOf(document)).map(name => ({name, link: canvas.carrier(document, name), place: placeOf(document, name)}))
      .filter(({name, link, place}) => link >= 0 && place && members(document, name).length > 0);
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
    this.studio.answers?.moved();
  }

  seek(t) {
    if (!this.run || !this.pageEngine) return;
    this.t = Math.min(Math.max(t, 0), this.end);
    const state = this.pageEngine.at(this.run, this.t);
    if (this.t > 0 || this.posed) this.motions = this.pageEngine.motions(state.q); else this.still();
    this.studio.redraw();
    this.studio.answers.moved();
  }

  /** Go to the time or the angle of the motor that a text names. */
  goTo(text) {
    if (!text.trim() || !this.end) return undefined;
    const t = timeOfText(text, this.run, this.pageEngine.scene, this.studio.curves.over.value);
    this.pause();
    if (t === null) return this.studio.say(`the motion does not come to "${text}": write 60 deg, or 0.3 s`, true);
    this.studio.say("");
    this.posed = null;
    return this.seek(t);
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
    const from = this.pageEngine.motions(state.q), place = item.kind === "pin" ? placeOf(document, item.name) : carryBack(from, link, at);
    Object.assign(this, {pulled: {link, place: place ?? middle(list(document, "link")[link], document)}, posed: {...state, t: 0}});
    this.pullTo(at);
  }

  pullTo(hand) {
    if (!this.pulled) return;
    const {link, place} = this.pulled, found = this.pageEngine.pull(this.posed, link, place, hand);
    this.posed = {t: 0, q: found.q, v: new Float64Array(this.pageEngine.size), closed: true, violation: found.violation};
    this.motions = this.pageEngine.motions(found.q);
    this.studio.hand = {at: carry(this.motions, link, place), to: hand};
    this.hand = hand;
    if (found.goesOn) requestAnimationFrame(() => { if (this.hand === hand) this.pullTo(hand); });
    this.studio.say(found.words || "pulled: press Home to return to the drawn position");
    this.showLoops(found.violation);
    this.studio.redraw();
  }

  /** Let go. Without motors the motion starts from here; with motors it returns to its course when played. */
  endPull() {
    if (!this.pulled) return;
    this.pulled = this.hand = this.studio.hand = null;
    this.release();
  }

  /** Compute the motion from the position shown, unless motors drive it. */
  release() {
    if (!this.pageEngine.scene.drivers.length) {
      this.t = 0;
      this.recompute();
    }
    this.motions = this.pageEngine.motions(this.posed.q);
    this.studio.redraw();
  }

  // Display

  /** Say how well the loops are closed, and when and why the motion ends. */
  showLoops(violation = null) {
    const {run, pageEngine, studio} = this;
    if (!pageEngine || (!run && violation === null)) return;
    const worst = violation ?? Math.max(0, ...Array.from(run.violation.slice(0, run.count))), done = !run || run.done;
    const closed = Number.isFinite(worst) ? `loops closed to ${worst.toExponential(0)}` : "loops not closed";
    const words = done ? "" : ` – ${run.words || "the motion ends"}${run.count > 1 ? ` at ${shown(run.t ?? this.end, "s")}` : ""}`;
    studio.parts.loops.textContent = run?.cause || (pageEngine.engine ? closed + words : `recorded motion: ${this.why || "this browser has no WebAssembly"}${words}`);
    studio.parts.loops.title = studio.parts.loops.textContent;
    studio.parts.loops.classList.toggle("bad", !done);
  }

  /** The last instant of a run that ended early by itself, whose cause is not known yet; else null. */
  get unexplained() {
    const {run} = this;
    return run && this.pageEngine.engine && !run.done && !run.isStopped && !run.cause && run.count > 1 && !this.posed ? this.lastState(run) : null;
  }

  lastState({ts, q, v, count, t}) {
    const {size} = this.pageEngine, from = (count - 1) * size, part = x => Array.from(x.subarray(from, from + size));
    return {t: ts[count - 1], q: part(q), v: part(v), end: t};
  }

  /** Show the cause of the end of a run. */
  explain(run, cause) {
    if (!cause || this.run !== run) return;
    run.cause = cause;
    this.showLoops();
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
