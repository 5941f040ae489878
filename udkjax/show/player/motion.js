// Motions: packed tables, and the positions of the bodies of a run at any time.

export const bytesOf = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
const floats = text => new Float32Array(bytesOf(text).buffer);

/** A packed table (udkjax/show/player/packing.py), row by row. Bit operations have only 32 bits; sums stay below 2^53. */
function unpack({rows, steps, bytes}) {
  const table = new Float64Array(rows * steps.length), source = bytesOf(bytes);
  let at = 0;
  for (let column = 0; column < steps.length; column++) {
    let value = 0, slope = 0;
    for (let row = 0; row < rows; row++) {
      let unsigned = 0, weight = 1, byte;
      do {
        byte = source[at++];
        unsigned += (byte & 127) * weight;
        weight *= 128;
      } while (byte > 127);
      slope += unsigned % 2 ? -(unsigned + 1) / 2 : unsigned / 2;
      value += slope;
      table[row * steps.length + column] = value * steps[column];
    }
  }
  return table;
}

/** The smallest 1, 2 or 5 times a power of ten that is at least x. */
export function nice(x) {
  const power = 10 ** Math.floor(Math.log10(x));
  return power * [1, 2, 5, 10].find(k => k * power >= x * (1 - 1e-9));
}

export const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
export const short = x => (x === 0 ? "0" : Math.abs(x) >= 1e5 || Math.abs(x) < 1e-3 ? x.toExponential(2) : String(+x.toPrecision(4))).replace("-", "−");

/** The interval of times that contains t: the indices of its ends, its length, and the position of t in it from 0 to 1. */
export function interval(ts, t, count = ts.length) {
  let low = 0, high = count - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (ts[middle] <= t) low = middle; else high = middle;
  }
  const h = ts[high] - ts[low];
  return [low, high, h, h > 0 ? clamp((t - ts[low]) / h, 0, 1) : 0];
}

/** The state {t, q, v} of a run of n coordinates at a time, by cubic Hermite interpolation. */
export function stateAt({ts, q, v, count, frame = 1}, t, n) {
  const [i, j, h, s] = interval(ts, t, count), r = 1 - s, found = {t, q: new Float64Array(n), v: new Float64Array(n)};
  for (let k = 0; k < n; k++) {
    const a = q[i * n + k], b = q[j * n + k], u = v[i * n + k] / frame, w = v[j * n + k] / frame;
    found.q[k] = a * r * r * (1 + 2 * s) + b * s * s * (3 - 2 * s) + h * s * r * (u * r - w * s);
    found.v[k] = h > 0 ? 6 * s * r * (b - a) / h + r * (1 - 3 * s) * u + s * (3 * s - 2) * w : u;
  }
  return found;
}

/** The positions of the bodies of a run at any time, by cubic Hermite interpolation; a mode is a sine. */
export class Run {
  constructor(record) {
    Object.assign(this, record);
    this.size = 3 * record.bodies.length;
    if (!record.mode) {
      this.ts = unpack(record.time);
      this.q = unpack(record.q);
      this.v = unpack(record.v);
    }
    this.measures = record.measures.map(m => ({...m, values: floats(m.values)}));
    this.forces = record.reactions && unpack(record.reactions.force);
    this.paths = null;
    this.fine = 4;  // points of a path per instant
    this.now = new Float64Array(this.size);
  }

  /** Another motion of the same bodies, with its events {t, name}. */
  replace(ts, q, v, measures, frame, events) {
    Object.assign(this, {ts, q, v, measures, frame, events, paths: null, fine: 1});
  }

  /** The coordinates and their rates at any time between the first and the last instant. */
  state(t) { return stateAt(this, t, this.size); }

  /** The joints that stick at a time. */
  stuck(t) { return (this.sticking ?? []).filter(({spans}) => spans.some(([from, to]) => from <= t && t <= to)); }

  find(t) { return interval(this.ts, t); }

  /** The coordinates x, y, angle of each body in turn; the next call reuses the array. */
  pose(t, amplitude = 1) {
    const out = this.now;
    if (this.mode) {
      const s = amplitude * Math.sin(2 * Math.PI * t);
      for (let k = 0; k < this.size; k++) out[k] = this.mode.q[k] + s * this.mode.shape[k];
      return out;
    }
    const [i, j, h, s] = this.find(t), n = this.size, {q, v} = this;
    const scale = h / this.frame, r = 1 - s;
    for (let k = 0; k < n; k++) {
      const a = q[i * n + k], b = q[j * n + k];
      out[k] = a * r * r * (1 + 2 * s) + b * s * s * (3 - 2 * s) + scale * s * r * (v[i * n + k] * r - v[j * n + k] * s);
    }
    return out;
  }

  /** The forces x, y at each anchor of reactions. */
  force(t) {
    const [i, j, , s] = this.find(t), n = 2 * this.reactions.anchors.length;
    return Array.from({length: n}, (_, k) => this.forces[i * n + k] * (1 - s) + this.forces[j * n + k] * s);
  }

  /** The paths of the traced points, through points at equal intervals of time. */
  trace() {
    if (!this.paths) {
      const first = this.ts[0], last = this.ts[this.ts.length - 1];
      const count = clamp(this.fine * this.ts.length, 2, 3000);
      this.paths = {first, last, count, lines: this.traces.map(() => new Float64Array(2 * count))};
      for (let i = 0; i < count; i++) {
        const pose = this.pose(first + (last - first) * i / (count - 1));
        this.traces.forEach((anchor, k) => this.paths.lines[k].set(place(pose, anchor), 2 * i));
      }
    }
    return this.paths;
  }
}

/** The place of an anchor [body, x, y]; body -1 is the ground. */
export function place(pose, [body, x, y]) {
  if (body < 0) return [x, y];
  const cos = Math.cos(pose[3 * body + 2]), sin = Math.sin(pose[3 * body + 2]);
  return [pose[3 * body] + cos * x - sin * y, pose[3 * body + 1] + sin * x + cos * y];
}

export const angleOf = (pose, body) => (body < 0 ? 0 : pose[3 * body + 2]);

const FITTED = 300;  // instants from which bounds are computed

/** Left, bottom, right, top (m) of everything drawn of a run, at least `least` to each side of the middle. */
export function boundsOf(run, least) {
  const anchors = run.marks.flatMap(m => {
    const [x0, y0] = m.at ?? [0, 0];
    return m.body === undefined ? [] : (m.points ?? [[0, 0]]).map(([x, y]) => [m.body, x0 + x, y0 + y]);
  });
  const low = [Infinity, Infinity], high = [-Infinity, -Infinity], stride = Math.max(1, Math.floor(run.ts.length / FITTED));
  for (let i = 0; i < run.ts.length; i += stride) {
    const pose = run.q.subarray(i * run.size, (i + 1) * run.size);
    for (const anchor of anchors) {
      place(pose, anchor).forEach((x, k) => { low[k] = Math.min(low[k], x); high[k] = Math.max(high[k], x); });
    }
  }
  const grow = low.map((x, k) => Math.max(0, least - (high[k] - x) / 2));
  return [...low.map((x, k) => x - grow[k]), ...high.map((x, k) => x + grow[k])];
}
