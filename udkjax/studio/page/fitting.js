// Pins that move as little as possible until conditions on their places hold.

import {movePin, pinsOf, placeOf} from "./document.js";
import {inOrder} from "./pin_forms.js";

const MOST = 150;  // conditions: more would take longer than a hand waits
const ROUNDS = 16;  // of Newton's method
const CLOSED = 1e-13;  // relative to the size of the drawing: errors of closed conditions
const STEP = 1e-6;  // relative to it: of differences
const GRAIN = 1e-11;  // relative to it: finer digits of places are errors of rounding
const DEPENDENT = 1e-12;  // relative to the largest: added to the diagonal, so that conditions may depend on each other

/**
 * The drawing with its pins moved, except for those that are `held`, so that all `conditions` hold: {pins, error}, the names of the pins, and a
 * function (m) of the places by name. Null if none is near, or there are too many. With the Jacobian J of the errors e, a step is -J^T (J J^T)^-1 e.
 */
export function fitted(document, conditions, held) {
  if (conditions.length > MOST) return null;
  const names = Object.keys(pinsOf(document)).filter(name => placeOf(document, name)), at = Object.fromEntries(names.map(name => [name, placeOf(document, name)]));
  const size = Math.max(...[0, 1].map(k => Math.max(...names.map(name => at[name][k])) - Math.min(...names.map(name => at[name][k])))) || 1;
  for (let round = 0; round < ROUNDS; round++) {
    const errors = conditions.map(({error}) => error(at));
    if (!errors.every(Number.isFinite)) return null;
    if (Math.max(...errors.map(Math.abs)) <= CLOSED * size) return moved(document, names, at, 10 ** Math.floor(Math.log10(GRAIN * size)));
    const rows = conditions.map(one => slopes(one, at, held, STEP * size)), gram = rows.map(a => rows.map(b => product(a, b)));
    const most = Math.max(...gram.map((row, k) => row[k])), weights = solved(gram.map((row, k) => row.with(k, row[k] + DEPENDENT * most)), errors);
    rows.forEach((row, k) => row.forEach(([dx, dy], name) => { at[name] = [at[name][0] - weights[k] * dx, at[name][1] - weights[k] * dy]; }));
  }
  return null;
}

/** The derivatives of an error by the places of its pins, by name. */
function slopes({pins, error}, at, held, step) {
  const by = (name, k) => [step, -step].map(h => error({...at, [name]: at[name].with(k, at[name][k] + h)})).reduce((a, b) => (a - b) / (2 * step));
  return new Map(pins.filter(name => !held.includes(name)).map(name => [name, [by(name, 0), by(name, 1)]]));
}

function product(a, b) {
  let sum = 0;
  for (const [name, [x, y]] of a) { const other = b.get(name); if (other) sum += x * other[0] + y * other[1]; }
  return sum;
}

/** The solution of a symmetric positive definite system, by Gaussian elimination. */
function solved(matrix, right) {
  const rows = matrix.map((row, k) => [...row, right[k]]), n = rows.length;
  for (let k = 0; k < n; k++) for (let i = k + 1; i < n; i++) {
    const factor = rows[i][k] / rows[k][k];
    if (factor) for (let j = k; j <= n; j++) rows[i][j] -= factor * rows[k][j];
  }
  const x = Array(n);
  for (let k = n - 1; k >= 0; k--) x[k] = (rows[k][n] - rows[k].slice(k + 1, n).reduce((sum, a, j) => sum + a * x[k + 1 + j], 0)) / rows[k][k];
  return x;
}

function moved(document, names, at, grain) {
  const rounded = ([x, y]) => [x, y].map(z => Math.round(z / grain) * grain + 0), isOther = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]) > grain;
  return inOrder(document, names).reduce((found, name) => (isOther(at[name], placeOf(found, name)) ? movePin(found, name, rounded(at[name])) : found), document);
}
