// The axis along which a run is shown: time, or the angle of a motor as the drawing counts it; and texts such as "60 deg" and "0.3 s".

import {interval} from "./player/motion.js";

const DEGREE = Math.PI / 180, TURN = 360, EPS = 1e-9;

/** The motors of a scene that turn links, in order. */
export const turningMotors = scene => scene.drivers.filter(({pair}) => pair);

/** The angle (degrees) of a motor at the instants of a run, counted as in the drawing. */
function anglesOf({q, count}, {pair, offset}, size) {
  const angle = (i, body) => (body < 0 ? 0 : q[i * size + 3 * body + 2]);
  return Float64Array.from({length: count}, (_, i) => (angle(i, pair[1]) - angle(i, pair[0]) + offset) / DEGREE);
}

/** The axis of a run: its `values` at the instants, of which the first `count` are shown, their `range` and `unit`, the value `at` a
 *  time, that `between` other values, and the time `timeOf` a value. One turn of a motor ends where its first one does. */
export function alongOf(run, scene, motor = "", isTurn = false) {
  const driver = turningMotors(scene).find(({name}) => name === motor), size = 3 * scene.bodies.length;
  const values = driver ? anglesOf(run, driver, size) : Float64Array.from(run.ts).slice(0, run.count), [first] = values;
  const between = (x, t) => { const [i, j, , s] = interval(run.ts, t, run.count); return x[i] + s * (x[j] - x[i]); };
  const end = driver && isTurn ? values.findIndex(x => Math.abs(x - first) > TURN) : -1, count = end < 0 ? values.length : end + 1;
  const sign = values[count - 1] < first ? -1 : 1, shown = values.slice(0, count), range = end < 0 ? [Math.min(...shown), Math.max(...shown)] : [first, first + sign * TURN].sort((a, b) => a - b);
  const wrapped = x => (end < 0 ? x : first + sign * ((sign * (x - first)) % TURN));
  const timeOf = value => firstTime(run, values, value, 0) ?? run.ts[nearest(values, value)];
  return {values, count, unit: driver ? "°" : "s", range, at: t => wrapped(between(values, t)), between, timeOf};
}

const nearest = (values, value) => values.reduce((best, x, k) => (Math.abs(x - value) < Math.abs(values[best] - value) ? k : best), 0);

/** The first time at which values pass a value, which counts modulo `period` unless it is 0; null if they never do. */
function firstTime({ts}, values, value, period) {
  for (let i = 0; i + 1 < values.length; i++) {
    const low = Math.min(values[i], values[i + 1]), high = Math.max(values[i], values[i + 1]);
    const wanted = period ? value + period * Math.ceil((low - value) / period - EPS) : value;
    if (wanted >= low - EPS && wanted <= high + EPS) return high > low ? ts[i] + (ts[i + 1] - ts[i]) * (wanted - values[i]) / (values[i + 1] - values[i]) : ts[i];
  }
  return null;
}

/** The time that a text names: "0.3 s", "60 deg", "1.2 rad", "0.5 turns", or a number, which is an angle if a motor turns; null if the
 *  motion does not come there. */
export function timeOfText(text, run, scene, motor = "") {
  const [, number, unit = ""] = /^\s*([-+]?[\d.]+(?:e[-+]?\d+)?)\s*([^\s\d]*)\s*$/i.exec(text) ?? [], value = Number(number);
  const driver = turningMotors(scene).find(({name}) => name === motor) ?? turningMotors(scene)[0];
  const degrees = {"": 1, "°": 1, deg: 1, rad: 1 / DEGREE, turn: TURN, turns: TURN, rev: TURN}[unit];
  if (number === undefined || !Number.isFinite(value)) return null;
  if (unit === "s" || (unit === "" && !driver)) return value >= 0 && value <= run.ts[run.count - 1] ? value : null;
  return driver && degrees ? firstTime(run, anglesOf(run, driver, 3 * scene.bodies.length), value * degrees, TURN) : null;
}
