// Keeps text, mistakes, engine and findings up to date with the drawing. Answers about an outdated drawing are dropped.

import {RequestError, ask} from "./api.js";
import {PageEngine} from "./page_engine.js";
import {loadEngine} from "./player/engine.js";
import {keepOutlines} from "./shapes.js";

const COMPILE_DELAY = 120;  // ms without a change before an engine is compiled, which takes the server half a second or more
const MOST_ENGINES = 12;  // of former structures, so that undo need not wait for the server
const DIAGNOSE_DELAY = 250;  // ms without a change before a drawing is diagnosed, which takes the server a second

/** The part of a drawing that its engine is compiled for: everything but the places of pins, which are parameters. */
const structureOf = ({pins, ...rest}) => JSON.stringify([Object.keys(pins ?? {}), rest]);

export class Sync {
  constructor(studio) {
    Object.assign(this, {studio, stamp: 0, structure: null, engines: new Map(), pending: Promise.resolve(), turn: Promise.resolve()});
  }

  /** Ask for a diagnosis once former ones are answered, lest they take all connections of the browser; null if `isLate` by then. */
  examine(request, isLate) {
    const answer = this.turn.then(() => (isLate() ? null : ask("diagnose", request)));
    this.turn = answer.catch(() => {});
    return answer;
  }

  /** Update everything for the current state; `settled` waits for it. */
  follow() {
    const stamp = ++this.stamp, {studio} = this;
    if (this.structure !== structureOf(studio.document) || !studio.motion.pageEngine?.engine) {
      this.structure = null;
      studio.motion.forget();
    }
    studio.findings.markStale();
    studio.answers.markStale();
    this.pending = this.update(stamp).catch(error => {
      if (stamp === this.stamp) studio.findings.showFailure(error.message);
      if (!(error instanceof RequestError)) throw error;
    });
  }

  /** Wait until text, motion and findings of the current state are known. */
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
    if (found.outlines?.length) {
      keepOutlines(found.outlines);
      studio.canvas.drawn = [];  // the symbols follow from them
      studio.redraw();
    }
    if (found.problems.length) {
      studio.answers.clear();
      this.structure = null;
      studio.motion.forget();
      return undefined;
    }
    if (!moves) await this.compile(found.text, state.document, isLate);
    if (isLate()) return undefined;
    await new Promise(done => { setTimeout(done, DIAGNOSE_DELAY); });
    if (!isLate()) await this.explainEnd(found.text, isLate);
    return isLate() ? undefined : this.diagnose(found.text, isLate);
  }

  empty() {
    this.structure = null;
    this.studio.motion.forget();
    this.studio.findings.showEmpty();
    this.studio.answers.clear();
  }

  async compile(text, document, isLate) {
    const {studio, engines} = this, structure = structureOf(document);
    studio.motion.showWaiting();
    const compiled = engines.get(structure) ?? await this.compiled(text, isLate);
    if (isLate()) return;
    if (compiled.problems.length) return void studio.findings.showProblems(compiled.problems);
    engines.delete(structure);
    if (compiled.engine) engines.set(structure, compiled);  // the last one used is the last one dropped
    if (engines.size > MOST_ENGINES) engines.delete(engines.keys().next().value);
    const pageEngine = await PageEngine.load(document, compiled, loadEngine);
    if (isLate()) return;
    this.structure = structure;
    await studio.motion.use(pageEngine, compiled.why ?? "");
  }

  /** The server's engine of a drawing, or its motion if machine code cannot express it; null if the drawing has changed meanwhile. */
  async compiled(text, isLate) {
    await new Promise(done => { setTimeout(done, COMPILE_DELAY); });
    if (isLate()) return null;
    const found = await ask("compile", {text, engine: typeof WebAssembly === "object" ? "wasm" : "recorded"});
    if (isLate() || found.problems.length || found.engine || found.motion) return found;
    return {...await ask("compile", {text, engine: "recorded"}), why: found.why};
  }

  /** Find out why the motion ends early. */
  async explainEnd(text, isLate) {
    const {motion} = this.studio;
    await motion.settled();
    const {unexplained: end, run} = motion;
    if (isLate() || !end) return;
    const found = await this.examine({text, about: "end", end}, isLate);
    if (!isLate()) motion.explain(run, found.cause);
  }

  async diagnose(text, isLate) {
    const {studio} = this, found = await this.examine({text}, isLate);
    if (isLate()) return undefined;
    studio.findings.showStructure(found);
    studio.motion.explain(studio.motion.run, found.conflict);
    if (found.problems.length || !studio.motion.pageEngine?.scene.drivers.length) return studio.answers.clear();
    const travel = await this.examine({text, about: "travel"}, isLate);
    if (isLate()) return undefined;
    studio.findings.showTravel(travel);
    return studio.answers.follow(text, isLate);
  }
}
