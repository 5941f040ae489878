// The server and the engine follow the drawing: its text with comments kept, its mistakes, the engine, and what is found about it.
// Answers that come too late, about a drawing that has changed since, are dropped.

import {RequestError, ask} from "./api.js";
import {Mover} from "./mover.js";
import {loadEngine} from "./player/engine.js";

const BREATH = 120;  // ms without a change before an engine is compiled, which takes the server half a second or more
const PAUSE = 250;  // ms without a change before a drawing is diagnosed, which takes the server a second

/** What an engine is compiled for: all of a drawing but the places of its pins, which are parameters. */
const structureOf = ({pins, ...rest}) => JSON.stringify([Object.keys(pins ?? {}), rest]);

export class Sync {
  constructor(studio) {
    Object.assign(this, {studio, stamp: 0, structure: null, pending: Promise.resolve()});
  }

  /** Let everything follow the present state; `settled` ends when it has. */
  follow() {
    const stamp = ++this.stamp, {studio} = this;
    if (this.structure !== structureOf(studio.document) || !studio.motion.mover?.engine) {
      this.structure = null;
      studio.motion.forget();
    }
    studio.findings.markStale();
    this.pending = this.update(stamp).catch(error => {
      if (stamp === this.stamp) studio.findings.showFailure(error.message);
      if (!(error instanceof RequestError)) throw error;
    });
  }

  /** End when the text of the present state is known, and with it its motion and what is found. */
  async settled() {
    for (let before = null; before !== this.pending;) {
      before = this.pending;
      await before.catch(() => {});
    }
  }

  async update(stamp) {
    const {studio} = this, {state} = studio, isLate = () => stamp !== this.stamp;
    const isEmpty = Object.keys(state.document.pins ?? {}).length === 0 && state.text === "";
    if (isEmpty) return this.empty();
    const moves = this.structure !== null;
    if (moves) studio.motion.follow(state.document);
    const request = state.text === null ? {text: state.base ?? "", document: state.document} : {text: state.text};
    const found = await ask("compile", request);
    if (state.text === null && studio.history.states.includes(state)) Object.assign(state, {text: found.text});
    if (isLate()) return undefined;
    studio.source.show();
    studio.files.showTitle();
    studio.findings.showProblems(found.problems);
    if (found.problems.length) {
      this.structure = null;
      studio.motion.forget();
      return undefined;
    }
    if (!moves) await this.compile(found.text, state.document, isLate);
    if (isLate()) return undefined;
    await new Promise(done => { setTimeout(done, PAUSE); });
    return isLate() ? undefined : this.diagnose(found.text, isLate);
  }

  empty() {
    this.structure = null;
    this.studio.motion.forget();
    this.studio.findings.showEmpty();
  }

  async compile(text, document, isLate) {
    const {studio} = this, hasWasm = typeof WebAssembly === "object";
    studio.motion.showWaiting();
    await new Promise(done => { setTimeout(done, BREATH); });
    if (isLate()) return;
    let compiled = await ask("compile", {text, engine: hasWasm ? "wasm" : "recorded"});
    if (isLate()) return;
    if (!compiled.problems.length && !compiled.engine && !compiled.motion) {  // what machine code has no instruction for
      compiled = {...await ask("compile", {text, engine: "recorded"}), why: compiled.why};
      if (isLate()) return;
    }
    if (compiled.problems.length) return void studio.findings.showProblems(compiled.problems);
    const mover = await Mover.load(document, compiled, loadEngine);
    if (isLate()) return;
    this.structure = structureOf(document);
    studio.motion.use(mover, compiled.why ?? "");
  }

  async diagnose(text, isLate) {
    const {studio} = this, found = await ask("diagnose", {text});
    if (isLate()) return;
    studio.findings.showStructure(found);
    if (found.problems.length || !studio.motion.mover?.scene.drivers.length) return;
    const travel = await ask("diagnose", {text, about: "travel"});
    if (!isLate()) studio.findings.showTravel(travel);
  }
}
