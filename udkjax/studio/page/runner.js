// The page's side of the thread that computes runs (run_worker.js). Of requests made while one is computed, only the last counts.

const PATIENCE = 300;  // ms that a run may take once a later one waits

export class Runner {
  /** `data` is the engine; `onWait` is called with the requests in hand, 0 or 1, whenever it changes. */
  constructor(data, onWait = () => {}) {
    Object.assign(this, {onWait, now: null, waiting: null});
    this.worker = new Worker(new URL("run_worker.js", import.meta.url), {type: "module"});
    this.worker.onmessage = ({data: answer}) => this.take(answer);
    this.worker.onerror = event => { event.preventDefault(); this.take({problem: event.message || "the thread that computes motions cannot be started"}); };
    this.worker.postMessage({data});
  }

  /** The run of a request; null if a later request took its place. */
  run(request) {
    this.waiting?.done(null);
    return new Promise((done, fail) => {
      this.waiting = {request, done, fail};
      if (this.now) setTimeout(() => { if (this.waiting && this.now) this.stop(); }, Math.max(0, this.now.since + PATIENCE - performance.now()));
      else this.next();
    });
  }

  next() {
    this.now = this.waiting;
    this.waiting = null;
    this.onWait(this.now !== null);
    if (!this.now) return;
    this.now.since = performance.now();
    this.worker.postMessage({request: this.now.request});
  }

  take({found, problem}) {
    const {now} = this;
    this.now = null;
    if (!now) return;
    if (problem === undefined) now.done(this.waiting && found.isStopped ? null : found); else now.fail(new Error(problem));
    this.next();
  }

  /** End the run in hand; it comes as far as it has been computed. */
  stop() { if (this.now) this.worker.postMessage("stop"); }

  close() {
    this.worker.terminate();
    for (const one of [this.now, this.waiting]) one?.done(null);
    this.now = this.waiting = null;
    this.onWait(false);
  }
}
