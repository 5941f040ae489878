// Pulling a body by a spring: the mechanism moves by its own dynamics, in real time.

const SWING = 2 * Math.PI * 1.5;  // rad per second of real time: natural frequency of the spring with half of all masses
const DAMPING = 0.7;  // damping ratio
const LONGEST_FRAME = 0.05;  // s of real time: in longer frames the motion lags

/** Pulls until it is released; `live` is the run, which has the engine and shows the motion. */
export class Hand {
  constructor(live, held, target) {
    const {engine, values} = live, numbers = engine.numbers(values), {speed} = live.player;
    const mass = 0.5 * engine.data.masses.reduce((sum, [k]) => sum + numbers[k], 0), rate = SWING / speed;
    Object.assign(this, {live, held, target});
    this.spring = {stiffness: mass * rate ** 2, damping: 2 * DAMPING * mass * rate};
    this.before = null;
    this.state = live.stateNow();
    live.record(this.state);
    this.request = requestAnimationFrame(now => this.frame(now));
  }

  frame(now) {
    this.request = requestAnimationFrame(later => this.frame(later));
    const seconds = this.before === null ? 0 : Math.min((now - this.before) / 1000, LONGEST_FRAME);
    this.before = now;
    if (seconds > 0) this.advance(seconds * this.live.player.speed);
  }

  advance(step) {
    const {live, state, held, spring, target} = this, t = state.t + step;
    const pull = {body: held.body, point: held.point, target, ...spring};
    const run = live.engine.run(live.values, state, [state.t, t], pull), n = live.engine.size;
    if (!run.done) {
      this.isBlocked = true;
      return live.live.say(`The pull is too strong: ${run.words}.`, true);
    }
    if (this.isBlocked) live.live.greet();  // replaces the message
    this.isBlocked = false;
    this.state = {t, q: run.q.slice(n), v: run.v.slice(n), marks: run.marks, watch: run.last.watch, mode: run.last.mode};
    live.append(this.state, run.violation[1], run.events);
    return null;
  }

  move(target) { this.target = target; }

  release() {
    cancelAnimationFrame(this.request);
    this.live.letGo(this.state);
  }
}

/** The topmost body at a pixel, with the point in its frame; null if there is none. */
export function bodyAt(painter, symbols, [x, y], reach) {
  for (const symbol of [...symbols].reverse()) {
    const {frame} = symbol;
    if (frame.length === 2 || frame[0] < 0 || !painter.holds(symbol, x, y, reach)) continue;
    const body = frame[0], {pose, view} = painter, angle = pose[3 * body + 2];
    const dx = (x - view.x) / view.scale - pose[3 * body], dy = (view.y - y) / view.scale - pose[3 * body + 1];
    return {body, point: [Math.cos(angle) * dx + Math.sin(angle) * dy, Math.cos(angle) * dy - Math.sin(angle) * dx]};
  }
  return null;
}
