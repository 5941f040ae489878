// The run of a drawing by its engine: the motion from the drawn position or another one, the energies, and the paths of pins.

import {carry, motionsOf} from "./motions.js";
import {stateAt} from "./player/motion.js";
import {PartRun} from "./player/part_run.js";

const INSTANTS = 401;
// Steps of a first attempt, which shows a standstill early, of the first part of a run, which few runs exceed, and of further parts,
// each of which begins with a new step size.
const ATTEMPT = 300, FIRST_PART = 2000, PART = 100;
const PIECE = 0.06, MOST_PIECES = 16;  // rad by which a link turns within a straight piece of a path, and most pieces between instants
const STILL = 1e-9;  // characteristic lengths, or rad: a smaller motion is rounding

/** The run of a request {parameters, drawn, order, length, duration, from, carried}.
 *
 *  `drawn` are the frames of bodies as drawn and `order` the bodies of links; `from` is a state, or null for the drawn position;
 *  `carried` is a list of pins with {name, link, place}. `goesOn` is called now and then and returns whether to go on.
 */
export async function computeRun(engine, {parameters, drawn, order, length, duration, from, carried}, goesOn) {
  const state = from ?? engine.close(parameters);
  const still = {ts: [0], q: state.q, v: state.v, count: 1, done: false, violation: [state.violation], drawn, energies: null, paths: []};
  if (state.closed && engine.data.why) return {...still, words: engine.data.why};
  if (!state.closed) return {...still, words: "the loops do not close as drawn"};
  const times = Float64Array.from({length: INSTANTS}, (_, k) => duration * k / (INSTANTS - 1));
  let parts = new PartRun(engine, parameters, state, times), isStopped = false;
  if (parts.goOn(ATTEMPT) && (parts.goOn(PART) || !parts.stands)) {
    parts = new PartRun(engine, parameters, state, times);
    for (let steps = FIRST_PART; !isStopped && parts.goOn(steps); steps = PART) isStopped = !await goesOn();
  }
  const {run, t, done, words} = parts;
  if (!run.count) return {...still, words};
  if (!isStopped && !moves(run, length)) return {...still, words: "nothing moves"};
  const energies = run.count > 1 ? engine.measure(parameters, {...run, marks: parts.state.marks ?? null}, true, false, true) : null;
  return {...run, t, done, isStopped, words: isStopped ? "stopped" : words, drawn, energies, paths: pathsOf(run, drawn, order, carried)};
}

/** True if any body moves during a run. */
function moves({q, count}, length) {
  const size = q.length / INSTANTS, least = STILL * length;
  for (let k = size; k < count * size; k++) if (Math.abs(q[k] - q[k % size]) > (k % 3 === 2 ? STILL : least)) return true;
  return false;
}

/** The paths of pins over a run: [x, y, ...] in metres, and the link that carries each; smooth also where links turn fast. */
export function pathsOf(run, drawn, order, carried) {
  const {ts, q, count} = run, size = drawn.length, lines = carried.map(() => []);
  if (count < 2) return [];
  const put = coordinates => {
    const motions = motionsOf(coordinates, drawn, order);
    carried.forEach(({link, place}, k) => lines[k].push(...carry(motions, link, place)));
  };
  put(q.subarray(0, size));
  for (let i = 1; i < count; i++) {
    let turned = 0;
    for (let k = 2; k < size; k += 3) turned = Math.max(turned, Math.abs(q[i * size + k] - q[(i - 1) * size + k]));
    const pieces = Math.min(Math.ceil(turned / PIECE), MOST_PIECES);
    for (let k = 1; k < pieces; k++) put(stateAt(run, ts[i - 1] + (ts[i] - ts[i - 1]) * k / pieces, size).q);
    put(q.subarray(i * size, (i + 1) * size));
  }
  return carried.map(({name, link}, k) => ({name, link, line: Float64Array.from(lines[k])}));
}
