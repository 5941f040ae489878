const mount = (() => {
"use strict";
const bytesOf = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
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
function nice(x) {
  const power = 10 ** Math.floor(Math.log10(x));
  return power * [1, 2, 5, 10].find(k => k * power >= x * (1 - 1e-9));
}
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
const short = x => (x === 0 ? "0" : Math.abs(x) >= 1e5 || Math.abs(x) < 1e-3 ? x.toExponential(2) : String(+x.toPrecision(4))).replace("-", "−");
/** The interval of times that contains t: the indices of its ends, its length, and the position of t in it from 0 to 1. */
function interval(ts, t, count = ts.length) {
  let low = 0, high = count - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (ts[middle] <= t) low = middle; else high = middle;
  }
  const h = ts[high] - ts[low];
  return [low, high, h, h > 0 ? clamp((t - ts[low]) / h, 0, 1) : 0];
}
/** The state {t, q, v} of a run of n coordinates at a time, by cubic Hermite interpolation. */
function stateAt({ts, q, v, count, frame = 1}, t, n) {
  const [i, j, h, s] = interval(ts, t, count), r = 1 - s, found = {t, q: new Float64Array(n), v: new Float64Array(n)};
  for (let k = 0; k < n; k++) {
    const a = q[i * n + k], b = q[j * n + k], u = v[i * n + k] / frame, w = v[j * n + k] / frame;
    found.q[k] = a * r * r * (1 + 2 * s) + b * s * s * (3 - 2 * s) + h * s * r * (u * r - w * s);
    found.v[k] = h > 0 ? 6 * s * r * (b - a) / h + r * (1 - 3 * s) * u + s * (3 * s - 2) * w : u;
  }
  return found;
}
/** The positions of the bodies of a run at any time, by cubic Hermite interpolation; a mode is a sine. */
class Run {
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
function place(pose, [body, x, y]) {
  if (body < 0) return [x, y];
  const cos = Math.cos(pose[3 * body + 2]), sin = Math.sin(pose[3 * body + 2]);
  return [pose[3 * body] + cos * x - sin * y, pose[3 * body + 1] + sin * x + cos * y];
}
const angleOf = (pose, body) => (body < 0 ? 0 : pose[3 * body + 2]);
const FITTED = 300;  // instants from which bounds are computed
/** Left, bottom, right, top (m) of everything drawn of a run, at least `least` to each side of the middle. */
function boundsOf(run, least) {
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
const SIZE = 12, HIGH = 14;  // px
const PIN = 7;  // px around the centre of a pin that names keep clear
const BESIDE = 14;  // px from a bar to its name
const ROUNDING = 1e-6;  // px2
const BOLD = 700;  // font weight of signs, and of names of selected elements
const PLACES = [[9, -12, "left"], [9, 14, "left"], [-9, -12, "right"], [-9, 14, "right"], [0, -20, "center"], [0, 22, "center"]];  // around a pin (px)
class Labels {
  constructor() { this.last = new Map(); }
  /** Begin a picture, in which pins are at `places` (px). */
  begin(painter, places) {
    this.painter = painter;
    const {clientWidth, clientHeight} = painter.context.canvas;
    this.whole = [0, 0, clientWidth, clientHeight];
    this.unit = Math.max(1, painter.pt);
    this.boxes = Array.from(places, ([x, y]) => [x - PIN, y - PIN, x + PIN, y + PIN]);
  }
  /** Write words at the first free one of several places [x, y, align], or else where they cover least; `key` identifies them. A
   *  sign is never covered: a name without another place is left out, unless it is bold. */
  put(key, words, places, colour, weight, isSign = false) {
    const {painter, last, boxes, unit, whole} = this, high = HIGH * unit;
    painter.context.font = `${weight} ${SIZE * unit}px system-ui`;
    const wide = painter.context.measureText(words).width;
    const boxOf = ([x, y, align]) => { const left = x - {left: 0, center: wide / 2, right: wide}[align]; return [left, y - high / 2, left + wide, y + high / 2]; };
    const shared = (a, b) => [0, 1].reduce((area, k) => area * Math.max(0, Math.min(a[k + 2], b[k + 2]) - Math.max(a[k], b[k])), 1);
    const cost = (area, sign) => (sign && area > ROUNDING ? Infinity : area);
    const covered = k => { const box = boxOf(places[k]); return boxes.reduce((sum, b) => sum + cost(shared(box, b), b.isSign), wide * high - shared(box, whole)); };
    const before = Math.min(last.get(key) ?? 0, places.length - 1);
    let found = before, least = covered(before);
    for (let k = 0; k < places.length && least > ROUNDING; k++) {
      const now = covered(k);
      if (now < least) [found, least] = [k, now];
    }
    last.set(key, found);
    if (least === Infinity && weight < BOLD) return;
    boxes.push(Object.assign(boxOf(places[found]), {isSign}));
    const [x, y, align] = places[found];
    painter.text(words, [x, y], colour, {size: SIZE, weight, align});
  }
}
const aroundPin = ([x, y], unit = 1) => PLACES.map(([dx, dy, align]) => [x + unit * dx, y + unit * dy, align]);
/** Places beside a bar between two pixels: at its middle or nearer to an end, below it first, then farther away. */
function besideBar([ax, ay], [bx, by]) {
  const length = Math.hypot(bx - ax, by - ay) || 1, turn = Math.sign(bx - ax) || 1;
  const [nx, ny] = [-turn * (by - ay) / length, turn * (bx - ax) / length], found = [];
  for (const away of [1, 2.2]) {
    for (const side of [1, -1]) {
      for (const s of [0.5, 0.3, 0.7]) {
        const x = side * nx, align = Math.abs(nx) < 0.4 ? "center" : x > 0 ? "left" : "right";
        found.push([ax + s * (bx - ax) + away * BESIDE * x, ay + s * (by - ay) + away * side * (BESIDE + 2) * ny, align]);
      }
    }
  }
  return found;
}
/** Places within a plate or a disc: at its middle (px), or some lines below or above. */
const within = ([x, y], isDisc) => (isDisc ? [17, -17, 31] : [0, 17, -17]).map(dy => [x, y + dy, "center"]);
/** Places at and around a pixel of a body. */
function around([x, y], unit) {
  return [[0, 0], [0, 17], [0, -17], [34, 0], [-34, 0], [0, 34], [0, -34], [44, 17], [-44, 17], [44, -17], [-44, -17], [0, 51], [0, -51]]
    .map(([dx, dy]) => [x + unit * dx, y + unit * dy, "center"]);
}
const THEMES = {
  light: {
    back: "#ffffff", panel: "#f5f7f9", ink: "#1b2430", soft: "#5a6676", line: "#d5dbe3", grid: "#edf0f4", accent: "#0067b0",
    onAccent: "#ffffff", force: "#b3261e", tint: 0.74,
    bodies: ["#0072b2", "#d55e00", "#009e73", "#c2559a", "#3a9bdc", "#b87a00", "#6b5bb5"],
  },
  dark: {
    back: "#11161d", panel: "#191f28", ink: "#e7ecf3", soft: "#9aa7b8", line: "#303a48", grid: "#1c232d", accent: "#5cb3f2",
    onAccent: "#0c1219", force: "#ff8a80", tint: 0.68,
    bodies: ["#4fb0ec", "#ff9055", "#3fcfa4", "#ea9fcb", "#93d2f6", "#f0bb4a", "#ab9cf2"],
  },
};
const FORCES = [[1e6, "MN"], [1e3, "kN"], [1, "N"], [1e-3, "mN"]];
const NOT_UNIQUE = [1.2, 4.2];  // pt: dashes of the arrow of a force that is not unique, shared by redundant constraints
const READABLE = 4.5;  // the contrast of small text that WCAG 2 requires at level AA
const part = (hex, k) => parseInt(hex.slice(1 + 2 * k, 3 + 2 * k), 16);
/** The contrast ratio of two colours, from 1 to 21, as defined by WCAG 2. */
function contrast(one, two) {
  const linear = x => (x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);
  const light = hex => [0.2126, 0.7152, 0.0722].reduce((sum, share, k) => sum + share * linear(part(hex, k) / 255), 0.05);
  const [a, b] = [light(one), light(two)];
  return Math.max(a, b) / Math.min(a, b);
}
/** A colour for text that is readable on all backgrounds of a theme: if needed, closer to its ink. */
function readable(colour, {back, panel, ink}) {
  let found = colour;
  for (let t = 0; Math.min(contrast(found, back), contrast(found, panel)) < READABLE && t < 1; t += 0.05) found = mix(colour, ink, t);
  return found;
}
/** The mixture of two colours, with t from 0 to 1. */
function mix(one, two, t) {
  return "#" + [0, 1, 2].map(k => Math.round(part(one, k) * (1 - t) + part(two, k) * t).toString(16).padStart(2, "0")).join("");
}
/** The cleared context of a canvas, in CSS pixels, at the resolution of the screen. */
function contextOf(canvas) {
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  const wide = Math.round(width * ratio), high = Math.round(height * ratio);
  if (canvas.width !== wide || canvas.height !== high) [canvas.width, canvas.height] = [wide, high];
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  context.lineCap = context.lineJoin = "round";
  return {context, width, height};
}
/** Draws at a pose. Sizes of symbols are in the unit `pt`, which grows with the panel. */
class Painter {
  constructor(context, view, theme, pt, pose) {
    Object.assign(this, {context, view, theme, pt, pose});
  }
  /** The pixel of a place in metres. */
  px([x, y]) {
    return [this.view.x + this.view.scale * x, this.view.y - this.view.scale * y];
  }
  anchor(anchor) {
    return this.px(place(this.pose, anchor));
  }
  at(mark) {
    return this.anchor([mark.body, ...mark.at]);
  }
  colour(body) {
    return body < 0 ? this.theme.soft : this.theme.bodies[body % this.theme.bodies.length];
  }
  /** The colour of a body's name. */
  textColour(body) { return readable(this.colour(body), this.theme); }
  line(points, width, colour, {closed = false, fill = null, dash = []} = {}) {
    const c = this.context;
    c.beginPath();
    points.forEach(([x, y], k) => (k ? c.lineTo(x, y) : c.moveTo(x, y)));
    if (closed) c.closePath();
    if (fill) { c.fillStyle = fill; c.fill(); }
    if (width) {
      c.setLineDash(dash.map(d => d * this.pt));
      c.lineWidth = width * this.pt;
      c.strokeStyle = colour;
      c.stroke();
      c.setLineDash([]);
    }
  }
  circle([x, y], radius, {fill = null, stroke = null, width = 1.5, from = 0, to = 2 * Math.PI} = {}) {
    const c = this.context;
    c.beginPath();
    c.arc(x, y, radius, from, to);
    if (fill) { c.fillStyle = fill; c.fill(); }
    if (stroke) { c.lineWidth = width * this.pt; c.strokeStyle = stroke; c.stroke(); }
  }
  head([x, y], angle, colour) {
    const size = 7.5 * this.pt, wide = 0.42;
    const corner = turn => [x - size * Math.cos(angle + turn), y - size * Math.sin(angle + turn)];
    this.line([[x, y], corner(wide), corner(-wide)], 0, colour, {closed: true, fill: colour});
  }
  arrow([x0, y0], [x1, y1], colour, dash = []) {
    const angle = Math.atan2(y1 - y0, x1 - x0), length = Math.hypot(x1 - x0, y1 - y0), back = Math.min(5 * this.pt, length);
    this.line([[x0, y0], [x1 - back * Math.cos(angle), y1 - back * Math.sin(angle)]], 2.2, colour, {dash});
    if (length > 2 * this.pt) this.head([x1, y1], angle, colour);
  }
  text(words, [x, y], colour, {align = "left", size = 12, weight = 400, halo = true, back = this.theme.back} = {}) {
    const c = this.context;
    c.font = `${weight} ${size * Math.max(1, this.pt)}px system-ui, -apple-system, "Segoe UI", Roboto, sans-serif`;
    c.textAlign = align;
    c.textBaseline = "middle";
    if (halo) {
      c.lineWidth = 4;
      c.strokeStyle = back;
      c.strokeText(words, x, y);
    }
    c.fillStyle = colour;
    c.fillText(words, x, y);
  }
  grid(width, height) {
    const step = nice(80 / this.view.scale), c = this.context;
    c.beginPath();
    for (let k = Math.ceil(-this.view.x / this.view.scale / step); k * step * this.view.scale + this.view.x < width; k++) {
      const x = Math.round(this.view.x + k * step * this.view.scale) + 0.5;
      c.moveTo(x, 0);
      c.lineTo(x, height);
    }
    for (let k = Math.ceil((this.view.y - height) / this.view.scale / step); this.view.y - k * step * this.view.scale > 0; k++) {
      const y = Math.round(this.view.y - k * step * this.view.scale) + 0.5;
      c.moveTo(0, y);
      c.lineTo(width, y);
    }
    c.lineWidth = 1;
    c.strokeStyle = this.theme.grid;
    c.stroke();
    return step;
  }
  /** Draw a scale bar as long as one step of the grid. */
  bar(step, height) {
    const {soft} = this.theme, length = step * this.view.scale, x = 14, y = height - 14;
    this.line([[x, y - 3], [x, y + 3], [x, y], [x + length, y], [x + length, y - 3], [x + length, y + 3]], 1.2 / this.pt, soft);
    const [value, unit] = step >= 1e3 ? [step / 1e3, "km"] : step >= 1 ? [step, "m"] : step >= 1e-2 ? [step * 100, "cm"]
      : step >= 1e-3 ? [step * 1e3, "mm"] : [step * 1e6, "µm"];
    this.text(`${+value.toPrecision(3)} ${unit}`, [x + length + 7, y], soft, {size: 11 / Math.max(1, this.pt)});
  }
  traces(run, t) {
    const c = this.context, {first, last, count, lines} = run.trace();
    const now = clamp((t - first) / (last - first || 1) * (count - 1), 0, count - 1), tail = Math.max(2, 0.06 * count);
    lines.forEach((line, k) => {
      const colour = this.colour(run.traces[k][0]);
      const stroke = (from, to, width, alpha) => {
        c.beginPath();
        for (let i = from; i <= to; i++) {
          const [x, y] = this.px([line[2 * i], line[2 * i + 1]]);
          if (i === from) c.moveTo(x, y); else c.lineTo(x, y);
        }
        c.globalAlpha = alpha;
        c.lineWidth = width * this.pt;
        c.strokeStyle = colour;
        c.stroke();
        c.globalAlpha = 1;
      };
      stroke(0, count - 1, 1, 0.4);
      stroke(Math.max(0, Math.ceil(now - tail)), Math.floor(now), 2.4, 0.8);
    });
  }
  /** Draw a ring around each joint that sticks. */
  sticking(run, t) {
    for (const {at} of run.stuck(t)) this.circle(this.anchor(at), 8 * this.pt, {stroke: this.theme.force, width: 3.5});
  }
  /** Draw arrows of forces, at most three times as long as the usual one, and a reference arrow with its force. */
  reactions(run, t, width, height) {
    const forces = run.force(t), {anchors, usual, unique} = run.reactions, length = 70 * this.pt, colour = this.theme.force;
    anchors.forEach((anchor, k) => {
      const [x, y] = this.anchor(anchor), fx = forces[2 * k] / usual, fy = forces[2 * k + 1] / usual;
      const size = length * Math.min(1, 3 / Math.hypot(fx, fy));
      if (size * Math.hypot(fx, fy) > 1.5 * this.pt) this.arrow([x, y], [x + size * fx, y - size * fy], colour, unique[k] ? [] : NOT_UNIQUE);
    });
    const reference = nice(usual / 2), [unit, name] = FORCES.find(([unit]) => reference >= unit) ?? FORCES.at(-1);
    const y = height - 14, words = `${short(reference / unit)} ${name}${unique.every(Boolean) ? "" : "; dashed: not unique"}`;
    this.text(words, [width - 14, y], colour, {align: "right", size: 11 / Math.max(1, this.pt)});
    const end = width - 14 - this.context.measureText(words).width - 7;
    this.arrow([end - length * reference / usual, y], [end, y], colour);
  }
  names(run) {
    const labels = run.labels ??= new Labels(), pins = run.marks.filter(mark => mark.kind === "pin"), unit = Math.max(1, this.pt);
    labels.begin(this, pins.map(mark => this.at(mark)));
    for (const mark of pins) labels.put(`pin ${mark.name}`, mark.name, aroundPin(this.at(mark), unit), this.theme.ink, 400);
    run.bodies.forEach((name, body) => labels.put(name, name, around(this.anchor([body, 0, 0]), unit), this.textColour(body), 600));
  }
}
/** True if a point is inside a closed line, or closer to a line than `reach`. */
function isNear([x, y], corners, closed, reach) {
  const ends = closed ? [...corners, corners[0]] : corners;
  let inside = false;
  for (let k = 1; k < ends.length; k++) {
    const [[ax, ay], [bx, by]] = [ends[k - 1], ends[k]], dx = bx - ax, dy = by - ay;
    const s = clamp(((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy || 1), 0, 1);
    if (Math.hypot(x - ax - s * dx, y - ay - s * dy) <= reach) return true;
    if ((ay > y) !== (by > y) && x < ax + dx * (y - ay) / dy) inside = !inside;
  }
  return inside && Boolean(closed);
}
/** Draws symbols at a pose. */
class SymbolPainter extends Painter {
  draw(symbols) {
    for (const symbol of symbols) {
      const {centre, size, corners} = this.outline(symbol), fill = this.tone(symbol.fill), stroke = this.tone(symbol.stroke);
      if (centre) this.circle(centre, size, {fill, stroke, width: symbol.width});
      else this.line(corners, symbol.width, stroke, {closed: symbol.closed, fill});
    }
  }
  /** The outline of a symbol (px): the centre and the radius of a circle, or the corners of a line. */
  outline({frame, radius, points}) {
    const [[x0, y0], cos, sin, scale] = this.axes(frame), {pt} = this;
    if (radius) {
      const [metres, units, least] = radius;
      return {centre: [x0, y0], size: Math.max(this.view.scale * metres + pt * units, pt * least)};
    }
    const corners = points.map(([x, y, px = 0, py = 0]) => {
      const along = scale * x + pt * px, up = scale * y + pt * py;
      return [x0 + cos * along - sin * up, y0 - sin * along - cos * up];
    });
    return {corners};
  }
  /** True if a symbol is at a pixel, or closer to it than `reach`. */
  holds(symbol, x, y, reach) {
    const {centre, size, corners} = this.outline(symbol);
    if (centre) return Math.hypot(x - centre[0], y - centre[1]) <= size + reach;
    return isNear([x, y], corners, symbol.closed, symbol.width * this.pt / 2 + reach);
  }
  /** The origin of a frame (px), the cosine and sine of the angle of its x axis, and its unit of length (px). */
  axes(frame) {
    if (frame.length === 2) {
      const [[x0, y0], [x1, y1]] = frame.map(anchor => this.anchor(anchor)), length = Math.hypot(x1 - x0, y1 - y0);
      return [[x0, y0], (x1 - x0) / (length || 1), (y0 - y1) / (length || 1), length];
    }
    const [body, x, y, angle, turns] = frame, turned = angle + (turns ? angleOf(this.pose, body) : 0);
    return [this.anchor([body, x, y]), Math.cos(turned), Math.sin(turned), this.view.scale];
  }
  /** A colour by its name. */
  tone(name) {
    const [kind, number] = name.split(":"), edge = number && this.colour(+number);
    if (!number) return this.theme[kind] ?? null;
    const tint = mix(edge, this.theme.back, this.theme.tint);
    return {edge, tint, spoke: mix(edge, tint, 0.25)}[kind];
  }
}
const LEFT = 12, RIGHT = 68;  // px at the sides of the curves; the smallest and the largest value are at the right
/** The position on the timeline, from 0 to 1, of x (px) in a strip with a width. */
const stripPart = (x, width) => clamp((x - LEFT) / (width - LEFT - RIGHT), 0, 1);
/** Draw one measure of all runs over the timeline, and a line at the time shown. */
function drawStrip(context, width, height, runs, name, start, end, t, theme, taken) {
  const left = LEFT, right = width - RIGHT, top = 40, bottom = height - 10;
  const found = runs.map(run => run.measures.find(m => m.name === name));
  const log = found.some(m => m?.log);
  const scaled = y => (log ? Math.log10(Math.max(Math.abs(y), 1e-300)) : y);
  let low = Infinity, high = -Infinity;
  for (const m of found) for (const y of m?.values ?? []) {
    if (Number.isFinite(y)) { low = Math.min(low, scaled(y)); high = Math.max(high, scaled(y)); }
  }
  const painter = new Painter(context, {x: 0, y: 0, scale: 1}, theme, 1, null);
  if (!(high >= low)) return painter.text("no values for this motion", [width / 2, height / 2], theme.soft, {align: "center", halo: false});
  const least = log ? 3 : 1e-12 * Math.max(Math.abs(low), Math.abs(high)) || 1;
  if (high - low < least) { low -= least / 2; high += least / 2; }
  const x = time => left + (right - left) * (time - start) / (end - start || 1);
  const y = value => bottom - (bottom - top) * (scaled(value) - low) / (high - low);
  painter.line([[left, bottom + 0.5], [right, bottom + 0.5]], 1, theme.line);
  found.forEach((m, k) => {
    if (!m) return;
    context.beginPath();
    let pen = false;
    runs[k].ts.forEach((time, i) => {
      if (!Number.isFinite(m.values[i])) { pen = false; return; }
      if (pen) context.lineTo(x(time), y(m.values[i])); else context.moveTo(x(time), y(m.values[i]));
      pen = true;
    });
    context.lineWidth = 1.6;
    context.lineJoin = "round";
    context.strokeStyle = theme.bodies[k % theme.bodies.length];
    context.stroke();
  });
  painter.line([[x(t), top - 4], [x(t), bottom]], 1.2, theme.ink);
  const ends = {size: 11, halo: false}, back = value => (log ? 10 ** value : value);
  painter.text(short(back(high)), [right + 7, top], theme.soft, ends);
  painter.text(short(back(low)), [right + 7, bottom - 1], theme.soft, ends);
  const now = runs.map((run, k) => {
    const [i, j, , s] = run.find(t), value = found[k]?.values[s < 0.5 ? i : j];
    return {value, words: found[k] ? `${Number.isFinite(value) ? short(value) : "–"}${found[k].unit && " " + found[k].unit}` : ""};
  });
  context.font = "600 12px system-ui";
  const whole = now.map(({words}, k) => `${runs[k].label}  ${words}`);
  const room = whole.reduce((sum, words) => sum + context.measureText(words).width + 18, taken) < width;
  let edge = width - LEFT;
  for (let k = runs.length - 1; k >= 0; k--) {
    const colour = theme.bodies[k % theme.bodies.length], {value} = now[k], words = room && runs.length > 1 ? whole[k] : now[k].words;
    if (!now[k].words) continue;
    painter.text(words, [edge, 17], readable(colour, theme), {align: "right", weight: 600, halo: false});
    if (Number.isFinite(value)) painter.circle([x(t), y(value)], 3.4, {fill: colour, stroke: theme.panel});
    edge -= context.measureText(words).width + 18;
  }
}
const STYLE = `
:host { display: block; }
.player { --radius: 8px; box-sizing: border-box; display: flex; flex-direction: column; font: 14px/1.4 system-ui, -apple-system, "Segoe UI",
  Roboto, "Helvetica Neue", Arial, sans-serif; color: var(--ink); background: var(--back); border: 1px solid var(--line);
  border-radius: var(--radius); overflow: hidden; position: relative; }
.player.fill { height: 100vh; height: var(--player-height, 100dvh); border: 0; border-radius: 0; }
.player *, .player *::before { box-sizing: border-box; }
header { display: flex; align-items: center; gap: 8px; padding: 10px 10px 10px 16px; border-bottom: 1px solid var(--line); }
h1 { font-size: 15px; font-weight: 600; margin: 0; flex: 1; min-width: 0; overflow: hidden; text-overflow: ellipsis; white-space: nowrap; }
.stage { display: grid; grid-auto-columns: minmax(0, 1fr); grid-auto-flow: column; min-height: 0; }
.fill .stage { flex: 1; }
.panel { position: relative; min-width: 0; min-height: 0; margin: 0; }
.panel + .panel { border-left: 1px solid var(--line); }
.narrow .stage { grid-auto-flow: row; grid-auto-rows: minmax(0, 1fr); }
.narrow .panel + .panel { border-left: 0; border-top: 1px solid var(--line); }
.panel canvas { display: block; width: 100%; height: 100%; touch-action: none; cursor: grab; outline-offset: -2px; }
.panel canvas:active { cursor: grabbing; }
figcaption { position: absolute; left: 16px; top: 10px; right: 16px; pointer-events: none; font-size: 13px; color: var(--soft);
  overflow-wrap: anywhere; }
figcaption b { color: var(--ink); font-weight: 600; }
.strip { position: relative; height: 104px; background: var(--panel); border-top: 1px solid var(--line); flex: none; }
.strip canvas { display: block; width: 100%; height: 100%; touch-action: none; cursor: ew-resize; }
.strip select { position: absolute; left: 8px; top: 3px; max-width: 46%; }
.controls { display: flex; flex-wrap: wrap; align-items: center; gap: 6px 8px; padding: 8px 10px; background: var(--panel);
  border-top: 1px solid var(--line); flex: none; }
.group { display: flex; flex-wrap: wrap; gap: 6px; align-items: center; }
.time { font-variant-numeric: tabular-nums; white-space: nowrap; min-width: 11ch; color: var(--soft); }
.time b { color: var(--ink); font-weight: 600; }
button, select { font: inherit; font-size: 13px; color: var(--ink); background: transparent; border: 1px solid transparent; border-radius: 6px;
  height: 32px; padding: 0 8px; margin: 0; cursor: pointer; }
button:hover, select:hover { background: color-mix(in srgb, var(--ink) 8%, transparent); }
button[aria-pressed="true"] { color: color-mix(in srgb, var(--accent) 75%, var(--ink)); background: color-mix(in srgb, var(--accent) 14%, transparent); }
button:disabled { opacity: 0.5; cursor: default; }
option { color: #111; background: #fff; }
:focus-visible { outline: 2px solid var(--accent); outline-offset: 1px; }
button svg { display: block; width: 18px; height: 18px; fill: currentColor; }
button.icon { width: 34px; padding: 0; display: grid; place-items: center; flex: none; }
button.primary { background: var(--accent); color: var(--on-accent); width: 40px; height: 40px; border-radius: 50%; }
button.primary:hover { background: color-mix(in srgb, var(--accent) 86%, var(--ink)); }
input[type="range"] { accent-color: var(--accent); height: 32px; margin: 0; cursor: pointer; }
.line { flex: 1 1 140px; min-width: 100px; position: relative; display: flex; }
.scrub { flex: 1; min-width: 0; }
.ticks { position: absolute; inset: -3px 0 auto; width: 100%; height: 12px; pointer-events: none; }
.happened { color: var(--force); font-weight: 600; }
.amplitude { display: flex; align-items: center; gap: 6px; font-size: 13px; color: var(--soft); }
.amplitude input { width: 96px; }
.help { position: absolute; inset: 0; display: grid; place-items: center; background: color-mix(in srgb, var(--back) 72%, transparent); z-index: 2; }
.help[hidden] { display: none; }
.help dl { display: grid; grid-template-columns: auto auto; gap: 5px 18px; margin: 0; padding: 18px 22px; background: var(--panel); max-height: 96%;
  overflow: auto; border: 1px solid var(--line); border-radius: var(--radius); box-shadow: 0 8px 30px rgb(0 0 0 / 22%); font-size: 13px; }
.help dt { font-weight: 600; text-align: right; white-space: nowrap; }
.help dd { margin: 0; color: var(--soft); }
@media (pointer: coarse) { button, select { height: 38px; } button.icon { width: 40px; } button.primary { width: 44px; height: 44px; } }
`;
const SPEEDS = [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100];
const ICONS = {
  play: "M7 4.5v15l13-7.5z",
  pause: "M6 4.5h4.2v15H6zM13.8 4.5H18v15h-4.2z",
  loop: "M17 3l4 4-4 4V8H8a3 3 0 0 0-3 3v1H3v-1a5 5 0 0 1 5-5h9zM7 21l-4-4 4-4v3h9a3 3 0 0 0 3-3v-1h2v1a5 5 0 0 1-5 5H7z",
  theme: "M12 3a9 9 0 1 0 0 18zM12 3a9 9 0 0 1 0 18v-2a7 7 0 0 0 0-14z",
};
const HELP = [
  ["Space", "play, pause"], ["← →", "one frame back, forward"], ["Shift ← →", "5 % back, forward"], ["Home End", "start, end"],
  ["+ −", "faster, slower"], ["T", "traces"], ["N", "names"], ["R", "reactions"], ["L", "repeat"], ["D", "dark or light"],
  ["0", "fit the view"], ["Wheel, pinch", "zoom"], ["Drag", "move the view"],
];
const LIVE_HELP = [["Drag a body", "pull it"], ["G", "show the first motion"], ["Backspace", "reset the numbers"]];
/** An element with properties and children; strings become text, never markup. */
function make(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(properties)) {
    if (key === "class") element.className = value;
    else if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else element.setAttribute(key, value);
  }
  element.append(...children);
  return element;
}
function button(content, title, action, kind = "") {
  return make("button", {type: "button", class: kind, title, "aria-label": title, onclick: action}, content);
}
const icon = name => svgIcon(ICONS[name]);
/** An icon from an SVG path, filled or stroked. */
function svgIcon(shape, isLine = false) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg"), path = document.createElementNS(svg.namespaceURI, "path");
  svg.setAttribute("viewBox", "0 0 24 24");
  svg.setAttribute("aria-hidden", "true");
  if (isLine) svg.classList.add("stroke");
  path.setAttribute("d", shape);
  path.setAttribute("fill-rule", "evenodd");
  svg.append(path);
  return svg;
}
/** Move the keyboard focus from clicked buttons to `focused`: otherwise the space bar would press the button again. */
function keepKeys(root, focused) {
  root.addEventListener("mousedown", event => {
    if (!event.target.closest("button") || event.target.closest("dialog")) return;
    event.preventDefault();
    focused.focus({preventScroll: true, focusVisible: false});
  });
}
const THUMB = 8, TICK = 7;  // px: half the width of the slider's thumb, by which the timeline is inset; height of a tick
const NAME_SHOWN = 0.04;  // fraction of the timeline during which the name of an event is shown
class EventMarks {
  constructor(player) {
    this.player = player;
    this.canvas = make("canvas", {class: "ticks", "aria-hidden": "true"});
    this.element = make("div", {class: "line"}, player.scrub, this.canvas);
  }
  draw() {
    const {runs, panels, data: {start, end}, theme, t} = this.player, {context, width, height} = contextOf(this.canvas);
    runs.forEach((run, k) => {
      context.beginPath();
      for (const event of run.events) {
        const x = THUMB + (width - 2 * THUMB) * (event.t - start) / (end - start || 1);
        context.moveTo(x, height - TICK);
        context.lineTo(x, height);
      }
      context.lineWidth = 2;
      context.strokeStyle = runs.length > 1 ? theme.bodies[k % theme.bodies.length] : theme.force;
      context.stroke();
      const last = run.events.findLast(event => event.t <= t && event.t >= t - NAME_SHOWN * (end - start));
      const stuck = run.stuck(t).map(({name}) => name), now = stuck.length ? `${stuck.join(", ")} ${stuck.length > 1 ? "stick" : "sticks"}` : "";
      const words = [now, last ? `${last.name}, ${+last.t.toPrecision(5)} s` : ""].filter(Boolean).join("; ");
      if (panels[k].happened.textContent !== words) panels[k].happened.textContent = words;
    });
  }
}
/** Dragging moves the view or, in a live page, pulls the body under the pointer; two fingers and the wheel zoom, a tap plays or
 *  pauses, a double tap fits the view. */
function followPointers(player, canvas, liveRun) {
  const down = new Map();
  let moved = 0, hand = null;  // distance moved, and the pointer that pulls
  const point = event => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  canvas.addEventListener("pointerdown", event => {
    if (event.button > 1) return;
    canvas.setPointerCapture(event.pointerId);
    down.set(event.pointerId, point(event));
    moved = 0;
    if (down.size === 1 && event.button === 0 && liveRun()?.bodyAt(canvas, point(event), event.pointerType)) hand = event.pointerId;
  });
  canvas.addEventListener("pointermove", event => {
    if (!down.has(event.pointerId)) {
      if (liveRun()) canvas.classList.toggle("holds", Boolean(liveRun().bodyAt(canvas, point(event), event.pointerType)));
      return;
    }
    const before = [...down.values()], old = down.get(event.pointerId), now = point(event);
    down.set(event.pointerId, now);
    moved += Math.hypot(now[0] - old[0], now[1] - old[1]);
    if (moved < 4) return;
    if (hand === event.pointerId) {
      if (liveRun().hand) liveRun().move(canvas, now);
      else if (!liveRun().grasp(canvas, old, event.pointerType)) hand = null;
      return;
    }
    const after = [...down.values()], centre = list => [0, 1].map(k => list.reduce((sum, p) => sum + p[k], 0) / list.length);
    const [cx, cy] = centre(before), [nx, ny] = centre(after);
    if (down.size === 2) {
      const apart = ([a, b]) => Math.hypot(a[0] - b[0], a[1] - b[1]);
      player.zoomAt(canvas, cx, cy, apart(after) / (apart(before) || 1));
    }
    player.zoom.x += nx - cx;
    player.zoom.y += ny - cy;
    player.draw();
  });
  const up = event => {
    if (hand === event.pointerId) { hand = null; liveRun().release(); }
    if (down.delete(event.pointerId) && event.type === "pointerup" && moved < 4) player.toggle("playing");
  };
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", up);
  canvas.addEventListener("dblclick", () => player.whole());
  canvas.addEventListener("wheel", event => {
    if (!player.options.fill && !event.ctrlKey && document.activeElement?.shadowRoot !== player.root.getRootNode()) return;
    event.preventDefault();
    player.zoomAt(canvas, ...point(event), Math.exp(-0.0015 * event.deltaY));
    player.draw();
  }, {passive: false});
}
const OPACITY = 0.4;
const side = ([ax, ay], [bx, by], [x, y]) => Math.sign((bx - ax) * (y - ay) - (by - ay) * (x - ax));
const edges = points => points.map((point, k) => [point, points[(k + 1) % points.length]]);
const cross = ([a, b], [c, d]) => side(a, b, c) * side(a, b, d) < 0 && side(c, d, a) * side(c, d, b) < 0;
/** True if two convex outlines, lines or points overlap or are closer to each other than `reach`. */
function touch(one, other, reach) {
  const holds = (outline, point) => isNear(point, outline.length > 1 ? outline : [outline[0], outline[0]], outline.length > 2, reach);
  return one.some(point => holds(other, point)) || other.some(point => holds(one, point))
    || edges(one).some(edge => edges(other).some(another => cross(edge, another)));
}
/** Paint the links that touch in the pose of a painter; `parts` and `pairs` are described in gap_records.py. Returns their parts. */
function paintTouching(painter, {parts, pairs}) {
  const {scale} = painter.view, {context, theme} = painter, found = new Set();
  const places = parts.map(({body, points}) => points.map(([x, y]) => painter.anchor([body, x, y])));
  for (const pair of pairs) {
    const [one, other] = pair;
    if (one.some(i => other.some(j => touch(places[i], places[j], scale * (parts[i].radius + parts[j].radius))))) pair.flat().forEach(k => found.add(k));
  }
  context.globalAlpha = OPACITY;
  for (const k of found) {
    const points = places[k].length > 1 ? places[k] : [places[k][0], places[k][0]];
    painter.line(points, 2 * scale * parts[k].radius / painter.pt, theme.force, {closed: true, fill: points.length > 2 ? theme.force : null});
  }
  context.globalAlpha = 1;
  return found;
}
/** The button of a player that leads to the least gap of its runs, and its key. */
class GapMarks {
  constructor(player) {
    const [least] = player.runs.map(run => run.gaps).filter(Boolean).sort((a, b) => a.least - b.least);
    this.show = () => { player.pause(); player.seek(least.t); };
    this.button = button("Least gap", `go to the least gap: ${least.words} (G)`, this.show);
  }
}
const EVENT_STEPS = 15;
/** The block of numbers of a run: its parts by name, each an array in the memory of the module. */
class Block {
  constructor(instance) {
    this.instance = instance;
    instance.begin();
    this.address = instance.reserve(8 * instance.module.size);
    instance.view(this.address, instance.module.size).fill(0);
  }
  part(name) {
    const [place, size] = this.instance.module.places[name];
    return this.instance.view(this.address + 8 * place, size);
  }
  put(name, numbers) { this.part(name).set(numbers); }
  number(name) { return this.part(name)[0]; }
  /** Copies of parts, by name. */
  copies(names) { return Object.fromEntries(names.map(name => [name, this.part(name).slice()])); }
}
/** The motion of one run: its block of numbers, and what the module `instants` asks for. */
class EventMotion {
  constructor(engine, numbers, settings) {
    Object.assign(this, {engine, numbers, settings, events: engine.data.events, marks: new Map()});
    this.instants = engine.instances.instants;
    this.instants.imports = {look: () => this.look(), project: () => this.project()};
    this.block = new Block(this.instants);
    const [conditions, actions, joints] = engine.numbersOfEvents(numbers);
    this.conditions = conditions;
    this.block.put("of_actions", actions);
    this.block.put("joint_numbers", joints);
    this.block.put("coordinates", Float64Array.from({length: engine.size}, (_, i) => engine.unit(i)));
    this.block.put("inverse_mass", engine.inverseMasses(numbers));
    this.block.put("rate", [settings.omega]);
  }
  /** The state at which a function of the host is asked. */
  get at() {
    const [t, q, v, phase, joints] = ["t", "q", "v", "phase", "joints"].map(name => this.block.part(`at_${name}`).slice());
    return {t: t[0], q, v, mode: {phase, joints}};
  }
  /** The state with its numbers and with the marks of its phase, which are found where the phase is entered first. */
  dressed({mode, ...state}) {
    const numbers = this.engine.inMode(this.numbers, mode), key = mode.phase.join();
    if (!this.marks.has(key)) this.marks.set(key, this.engine.markRows(numbers, state));
    return [numbers, {...state, marks: this.marks.get(key)}];
  }
  look() { this.block.put("look", this.engine.evaluate("states", this.settings, ...this.dressed(this.at))); }
  project() { this.block.put("project", this.engine.evaluate("project", this.settings, ...this.dressed(this.at))); }
  /** The present mode; the same object as long as it stays. */
  get mode() {
    const mode = this.block.copies(["phase", "joints"]), same = (x, y) => x.every((value, k) => Object.is(value, y[k]));
    if (!this.latest || !same(mode.phase, this.latest.phase) || !same(mode.joints, this.latest.joints)) this.latest = mode;
    return this.latest;
  }
  /** Integrate to the next crossing, at most to the last of `times`. */
  advance(times, limit) {
    const {block, events, engine} = this, {scales} = engine.data, pick = (x, of) => of.map(k => x[k]), E = events.zeros.length;
    const state = {t: times[0], q: block.part("q").slice(), v: block.part("v").slice(), mode: this.mode}, scale = block.part("scale");
    const floors = events.zeros.map((zero, k) => zero * scale[k]);
    const force = events.zero * scales.mass * scales.length * this.settings.omega ** 2, forces = events.watched.slice(E).map(() => force);
    const watch = [...this.conditions, ...pick(block.part("sides"), events.watched), ...pick(block.part("watched"), events.watched),
      ...floors, ...forces, ...events.directions, events.slowest];
    const [numbers, dressed] = this.dressed(state), part = engine.piece(numbers, this.settings, dressed, times, limit, watch), n = engine.size;
    const [crossed, t, worst] = part.crossing;
    block.put("t", [t]);
    block.put("q", part.crossing.subarray(-2 * n, -n));
    block.put("v", part.crossing.subarray(-n));
    block.put("event", [crossed < 0 ? events.no_event : events.watched[crossed]]);
    events.watched.forEach((k, place) => { block.part("sides")[k] = part.crossing[events.head + place]; });
    return {...part, crossed: crossed >= 0, sure: t, worst};
  }
  /** Apply what happens at an instant, by `begin` or `settle`; returns the events {t, index, q, v}, with their states before. */
  apply(name) {
    const {block, instants, engine: {size: n}} = this;
    instants.exports[name](block.address);
    const count = block.number("events"), of = part => block.part(`events_${part}`), times = of("time"), names = of("name"), q = of("q"), v = of("v");
    return Array.from({length: count}, (_, k) => ({t: times[k], index: names[k], q: q.slice(k * n, (k + 1) * n), v: v.slice(k * n, (k + 1) * n)}));
  }
}
/** `Engine.run` for an engine with events; these stop the motion only if `stops`. */
function runWithEvents(engine, numbers, settings, state, ts, stops, limit) {
  const {data: {events, drift_tol: driftTol}, size: n} = engine, T = ts.length, end = ts[T - 1], {results} = events;
  const run = new EventMotion(engine, numbers, settings), {block} = run;
  const found = {ts, q: new Float64Array(T * n), v: new Float64Array(T * n), violation: new Float64Array(T), modes: Array(T).fill(null), count: 0,
    events: [], steps: 0, tried: 0, done: false, limited: false, words: "", stop: null};
  const {instances: {instants, run: {module: {bytes}}}} = engine, isPart = limit < settings.max_steps, stepsOfEvent = EVENT_STEPS * instants.module.bytes / bytes;
  let first = 0, violation = 0, mode = null;
  const put = (row, q, v, open) => { found.q.set(q, row * n); found.v.set(v, row * n); found.violation[row] = open; found.modes[row] = mode; };
  const now = () => block.number("t"), putNow = () => put(first++, block.part("q"), block.part("v"), violation);
  const finish = (words, more = {}) => {
    const last = {t: now(), q: block.part("q").slice(), v: block.part("v").slice(), mode, watch: block.copies(events.kept)};
    last.marks = run.dressed(last)[1].marks;
    return Object.assign(found, {words, t: last.t, last, marks: last.marks, count: first, ...more});
  };
  const stop = words => {  // with the current state as the last output
    if (first < T && !(first && ts[first - 1] === now())) {
      ts[first] = now();
      putNow();
    }
    return finish(words, {stop: stops ? words : null});
  };
  const nameOf = index => events.names[index];
  for (const [name, x] of Object.entries(state.watch ?? events.starts)) block.put(name, x);
  if (state.watch) {  // it goes on from the end of another run
    block.put("running", [1]);
    block.put("code", [results.successful]);
    block.put("event", [events.no_event]);
  } else block.put("joints", engine.jointsIn(numbers));
  block.put("t", [ts[0]]);
  block.put("q", state.q);
  block.put("v", state.v);
  block.put("end", [end]);
  if (!state.watch && run.instants.exports.begin) run.apply("begin");
  for (;;) {
    if (block.number("running")) found.events.push(...run.apply("settle"));
    mode = run.mode;
    if (block.number("code") === results.event_stop && !stops) {
      block.put("code", [results.successful]);
      block.put("running", [now() < end ? 1 : 0]);
    }
    const code = block.number("code");
    while (first < T && ts[first] <= now()) putNow();
    if (!block.number("running")) {
      const lastEvent = found.events.at(-1);
      if (code === results.successful) {
        while (first < T) putNow();
        return finish("", {done: true});
      }
      if (code === results.event_stop) return stop(`stopped by ${nameOf(lastEvent.index)}`);
      if (code === results.at_rest) return stop(`${nameOf(lastEvent.index).replace(/ rests$/, "")} has come to rest`);
      if (code === results.undefined_condition) return finish(`the condition of ${nameOf(block.part("undefined").findIndex(x => x > 0))} is not a number`);
      return finish(events.words[code] ?? "an event is impossible");
    }
    if (found.events.length >= events.most) return finish(`more than ${events.most} events`);
    if (block.number("event") !== events.no_event) continue;  // another event at the same instant
    if (isPart && found.tried + stepsOfEvent * found.events.length >= limit) return finish("", {limited: true});
    const times = Float64Array.of(now(), ...ts.subarray(first)), part = run.advance(times, limit - found.tried);
    found.steps += part.steps;
    found.tried += part.tried;
    for (let k = 1; k < part.count && times[k] <= part.sure; k++) {
      put(first++, part.q.subarray(k * n, (k + 1) * n), part.v.subarray(k * n, (k + 1) * n), part.violation[k]);
    }
    violation = part.worst;
    if (!(part.worst <= driftTol)) return finish("the loops do not stay closed");
    if (!part.done && !part.crossed) return finish(part.words, {limited: part.limited});
  }
}
const STACK = 1 << 20, PAGE = 1 << 16, LINE = 64;  // bytes: more than any stack needs, the unit in which memory grows, alignment
const STATUSES = ["running", "done", "step_limit", "step_too_small", "not_finite", "lost", "singular", "spurious_rank", "missing_rank", "crossed", "unresolved", "interrupted"];
const UNFINISHED = {step_limit: "too many steps", step_too_small: "the step became too small", not_finite: "a number is not finite",
  lost: "the loops do not stay closed", unresolved: "the condition of an event varies too quickly"};
const EPS = 2 ** -52;
const numbersOf = text => new Float64Array(bytesOf(text).buffer);
const largest = (x, unit) => x.reduce((most, value, k) => Math.max(most, Math.abs(value) / unit(k)), 0);
async function inflate(text) {
  const stream = new Blob([bytesOf(text)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}
/** A module with its own memory: constants, stack, and then the data of a call, which the next call overwrites. */
class Instance {
  static async load(module) {
    const found = new Instance();
    found.module = module;
    found.start = Math.ceil((module.data_end + STACK) / LINE) * LINE;
    found.memory = new WebAssembly.Memory({initial: Math.ceil(found.start / PAGE) + 1});
    const env = {__linear_memory: found.memory, malloc: size => found.reserve(Number(size)), free: () => {}};
    for (const name of ["look", "project"]) env[name] = () => found.imports[name]();  // set by each run
    env.__stack_pointer = new WebAssembly.Global({value: "i32", mutable: true}, found.start);
    const {instance} = await WebAssembly.instantiate(await inflate(module.code), {env});
    found.exports = instance.exports;
    return found;
  }
  begin() { this.end = this.start; }
  /** Reserve bytes of memory and return their address. */
  reserve(size) {
    const place = this.end;
    this.end = Math.ceil((place + size) / LINE) * LINE;
    const missing = this.end - this.memory.buffer.byteLength;
    if (missing > 0) this.memory.grow(Math.ceil(missing / PAGE));
    return place;
  }
  put(numbers) {
    const place = this.reserve(8 * numbers.length);
    new Float64Array(this.memory.buffer, place, numbers.length).set(numbers);
    return place;
  }
  view(place, count) { return new Float64Array(this.memory.buffer, place, count); }
  /** Call `run` for one member: `inputs` are arrays by name, `results` the sizes of the arrays to return. */
  run(inputs, results, counts) {
    this.begin();
    const fields = {members: 1, directions: 0, next: this.put([0]), ...counts}, given = {};
    for (const name of this.module.inputs) fields[name] = this.put(inputs[name]);
    for (const name of this.module.results) fields[name] = given[name] = this.put(new Float64Array(results[name]));
    const record = this.reserve(8 * this.module.fields.length);
    const words = new BigInt64Array(this.memory.buffer, record, this.module.fields.length);
    this.module.fields.forEach((name, k) => { words[k] = BigInt(fields[name] ?? 0); });
    this.exports.run(record);
    return Object.fromEntries(this.module.results.map(name => [name, this.view(given[name], results[name]).slice()]));
  }
}
class Engine {
  constructor(data, instances) {
    this.data = data;
    this.instances = instances;
    this.parameters = data.parameters;
    this.values = Float64Array.from(data.parameters, p => p.value);
    this.base = numbersOf(data.numbers);
    this.samples = numbersOf(data.samples);
    this.size = 3 * data.bodies.length;
    this.row = data.sampled.length;
  }
  /** All numbers of the scene, followed by the times at which the motion is not smooth. */
  numbers(parameters) {
    if (!parameters || !this.parameters.length) return this.base.slice();
    const module = this.instances.evaluate;
    module.begin();
    const given = module.put(parameters), to = module.put(this.base);
    module.exports.numbers(given, to);
    return module.view(to, this.base.length).slice();
  }
  /** The numbers of conditions, of actions, and of joints that events add. */
  numbersOfEvents(numbers) {
    let place = this.data.count + this.data.knots;
    return this.data.of_events.map(size => numbers.subarray(place, place += size));
  }
  /** Numbers in another mode {phase, joints}: the constraints that hold, and the numbers of joints that events have added. */
  inMode(numbers, mode) {
    if (!mode) return numbers;
    const found = numbers.slice(), {switches, joints} = this.data.events;
    joints.forEach((place, k) => { if (place >= 0) found[place] = mode.joints[k]; });
    switches.forEach(([place, k]) => { found[place] = mode.phase[k]; });
    return found;
  }
  /** Return true if a row of Psi holds in a mode, by default that in which a run begins. */
  holds(row, mode) {
    const {events} = this.data, which = events?.switch_of_row[row] ?? -1;
    return which < 0 || (mode?.phase ?? events.starts.phase)[which] > 0.5;
  }
  /** The numbers of joints that events have added. */
  jointsIn(numbers) { return Float64Array.from(this.data.events.joints, place => (place < 0 ? 0 : numbers[place])); }
  /** All numbers of the scene, with the spring that pulls a body. */
  pulled(parameters, pull) {
    const numbers = this.numbers(parameters);
    if (pull) [...pull.point, ...pull.target, pull.stiffness, pull.damping].forEach((x, k) => { numbers[this.data.pulls[pull.body][k]] = x; });
    return numbers;
  }
  breaks(numbers) { return numbers.slice(this.data.count, this.data.count + this.data.knots).sort(); }
  /** The numbers of the equations in the form that a module takes: with marks of rows (optional), two thresholds, and the samples
   *  that are valid at a time. */
  dressed(numbers, thresholds, t, marks = null) {
    const {count} = this.data, found = new Float64Array(count + (marks?.length ?? 0) + 2);
    found.set(numbers.subarray(0, count));
    if (marks) found.set(this.data.shared ? this.data.rows.map(unit => this.data.scales.length / unit) : marks, count);
    found.set(thresholds, found.length - 2);
    const passed = this.breaks(numbers).filter(b => b <= t).length;
    this.data.sampled.forEach((place, k) => { found[place] = this.samples[passed * this.row + k]; });
    return found;
  }
  guess(numbers) {
    const {q, v} = this.data.guess;
    return {t: 0, q: Float64Array.from(q, k => numbers[k]), v: Float64Array.from(v, k => numbers[k])};
  }
  unit = k => (k % 3 === 2 ? 1 : this.data.scales.length);
  /** Find the closed state nearest to a guess {t, q, v}, by default that of the scene.
   *
   *  Returns t, q and v; `violation` of Psi and `rate` of Psi_dot, the largest of their rows in units of the scene; the `rank` of
   *  Psi_q; and `closed`, which is false if only an approximately closed state was found.
   */
  close(parameters = null, guess = null) {
    const {data} = this, numbers = this.numbers(parameters), start = {...this.guess(numbers), ...guess}, m = data.rows.length;
    const given = this.dressed(numbers, data.closing.thresholds, start.t);
    const inputs = {numbers: given, ts: [start.t, start.t], q: start.q, v: start.v, settings: data.closing.settings,
      rows: data.rows, breaks: []};
    const found = this.instances.close.run(inputs, {state: 2 * this.size, residuals: 2 * m, rank: 1}, {times: 2, knots: 0});
    const q = found.state.slice(0, this.size), v = found.state.slice(this.size), row = k => data.rows[k % m];
    const violation = largest(found.residuals.slice(0, m), row), rate = largest(found.residuals.slice(m), row);
    const tol = Math.max(data.closing.tol, data.closing.rounding * EPS * Math.max(1, largest(q, this.unit)));
    const closed = violation <= tol && rate <= tol * Math.max(data.scales.rate, largest(v, this.unit));
    return {t: start.t, q, v, violation, rate, rank: found.rank[0], closed};
  }
  /** The independent rows of Psi near a closed state {t, q, v}: 1 for each of them, 0 for others; null if all are. */
  mark(parameters, state) { return this.markRows(this.numbers(parameters), state); }
  markRows(numbers, {t, q, v}) {
    const {data} = this;
    if (!data.marks) return null;
    const given = this.dressed(numbers, data.closing.thresholds, t);
    const settings = [data.scales.length, Math.max(data.scales.rate, largest(v, this.unit))];
    const inputs = {numbers: given, ts: [t, t], q, v, settings, rows: data.rows, breaks: []};
    return this.instances.mark.run(inputs, {marks: data.marks}, {times: 2, knots: 0}).marks;
  }
  /** Why the friction of joints cannot be computed: redundant rows share their loads, and the engine has code for some of them. */
  otherShares(numbers, state) {
    const {shared} = this.data, marks = shared && this.markRows(numbers, state);
    return marks && marks.some((mark, k) => (mark === 0) !== shared.includes(k)) ? "with these numbers other constraints are redundant, and share loads that friction depends on" : "";
  }
  /** Integrate the motion from a closed state {q, v} at times[0]; missing `marks` of the state are computed.
   *
   *  `pull` is a spring {body, point, target, stiffness, damping} that pulls a body (its index): point in its frame and target in
   *  the ground frame (m), stiffness (N/m) and damping (N s/m). During a pull no event stops the motion.
   *  `limit` is the largest number of attempted steps, by default 20,000; a run that reaches it can continue from its `last` state.
   *  Returns the times ts, q and v, and the `violation` of Psi (in units of the scene), of which the first `count` are valid;
   *  `done`, and if it is false the reason in `words`; the number of `steps`; the `last` state; its `marks`; and `events`, a list of
   *  {t, index, q, v}, where `index` is that of a name in `data.events.names`. If an event stops the motion, `stop` is the reason, and
   *  the last time is that of the event. `modes` has, for each time, which constraints hold; parts of a motion in one mode share it.
   */
  run(parameters, state, times, pull = null, limit = this.data.settings.max_steps) {
    const {data} = this, T = times.length;
    if (data.why) throw new Error(data.why);
    const end = Math.max(Math.abs(times[0]), Math.abs(times[T - 1])), smallest = data.smallest * EPS * end;
    const omega = Math.max(data.scales.rate, largest(state.v, this.unit), 1 / (times[T - 1] - times[0]));
    const numbers = this.pulled(parameters, pull), settings = {...data.settings, smallest, omega};
    const others = this.otherShares(numbers, {t: times[0], ...state});
    if (others) return {ts: Float64Array.from(times), q: new Float64Array(T * this.size), v: new Float64Array(T * this.size), violation: new Float64Array(T),
      count: 0, done: false, words: others, t: times[0], steps: 0, tried: 0, limited: false, last: {t: times[0], ...state}, marks: null, events: []};
    if (data.events) return runWithEvents(this, numbers, settings, state, Float64Array.from(times), !pull, limit);
    return {...this.piece(numbers, settings, state, Float64Array.from(times), limit), events: []};
  }
  /** Integrate from a state over times, up to the first zero `crossing` of the conditions in `watch`. */
  piece(numbers, settings, state, ts, limit, watch = []) {
    const {data, size} = this, T = ts.length, breaks = this.breaks(numbers), marks = state.marks ?? this.markRows(numbers, {t: ts[0], ...state});
    const inputs = {numbers: this.dressed(numbers, data.thresholds, ts[0], marks), ts, q: state.q, v: state.v,
      settings: Object.values({...settings, max_steps: limit}), rows: data.rows, breaks, samples: this.samples, watch};
    const info = data.info.length, results = {qs: T * size, vs: T * size, violation: T, info: info + 2 * size};
    if (data.events) results.crossing = data.events.head + data.events.watched.length + 2 * size;
    const found = this.instances.run.run(inputs, results, {times: T, knots: breaks.length});
    const ended = Object.fromEntries(data.info.map((name, k) => [name, found.info[k]]));
    const status = STATUSES[ended.code], limited = status === "step_limit";
    let done = status === "done", count = done ? T : Math.min(ended.written + 1, T - 1), words = UNFINISHED[status] ?? "";
    if (ended.lost < count) { done = false; count = ended.lost; words = UNFINISHED.lost; }
    const last = {t: ended.t, marks, q: found.info.slice(info, info + size), v: found.info.slice(info + size)};
    return {ts, q: found.qs, v: found.vs, violation: found.violation, count, done, words, t: ended.t,
      steps: ended.accepted, tried: ended.tried, limited, last, marks, crossing: found.crossing};
  }
  /** Evaluate a module at a state: `states`, the conditions of events, or `project`. */
  evaluate(name, settings, numbers, {t, q, v, marks}) {
    const instance = this.instances[name], {module} = instance, [conditions] = this.numbersOfEvents(numbers);
    const inputs = {numbers: this.dressed(numbers, this.data.thresholds, t, marks), ts: [t, t], q, v, rows: this.data.rows, breaks: [],
      settings: module.settings.map(name => settings[name]), event_numbers: [...conditions, ...this.inverseMasses(numbers)]};
    return instance.run(inputs, {found: module.count}, {times: 2, knots: 0}).found;
  }
  /** One over the mass, or the inertia, of each coordinate. */
  inverseMasses(numbers) { return this.data.masses.flatMap(([mass, inertia]) => [1 / numbers[mass], 1 / numbers[mass], 1 / numbers[inertia]]); }
  /** Energies (J) at the states of a run and, if requested, the force or torque of each driver (N or N m) with the power of all
   *  friction (W), and the forces x, y (N) of the joints of `data.forces`, for all joints time by time, and accelerations `a`; these
   *  are empty if rows are redundant: forces are not unique. */
  measure(parameters, run, efforts = false, forces = false, accelerations = false) {
    if (run.modes) return this.measureParts(parameters, run, efforts, forces);
    const {ts, q, v, count, mode, marks = null} = run;
    const {data, size} = this, module = this.instances.evaluate, {places} = module.module;
    const rubs = efforts && data.friction, wanted = efforts ? data.efforts.filter(({row}) => !marks || marks[row]) : [], unique = !marks || marks.every((mark, row) => mark || !this.holds(row, mode));
    const numbers = this.inMode(this.numbers(parameters), mode), breaks = this.row ? this.breaks(numbers) : [];
    module.begin();
    const given = module.reserve(8 * (data.count + data.marks + 2)), work = module.reserve(8 * module.module.size);
    module.view(work, module.module.size).fill(0);
    const at = name => module.view(work + 8 * places[name], 1), copy = (name, from) => module.view(work + 8 * places[name], size).set(from);
    const found = {kinetic: new Float64Array(count), potential: new Float64Array(count),
      efforts: Object.fromEntries((efforts ? data.efforts : []).map(({driver}) => [driver, new Float64Array(count).fill(NaN)])),
      friction: rubs ? new Float64Array(count) : null, a: accelerations ? new Float64Array(count * size) : null, forces: new Float64Array(forces && unique ? 2 * data.forces.length * count : 0)};
    let next = -Infinity;  // time of the next sample, which changes the constants
    for (let i = 0; i < count; i++) {
      if (ts[i] >= next) {
        module.view(given, data.count + data.marks + 2).set(this.dressed(numbers, data.thresholds, ts[i], marks));
        module.exports.prologue(given, work);
        next = breaks.find(b => b > ts[i]) ?? Infinity;
      }
      at("t")[0] = ts[i];
      copy("q", q.subarray(i * size, (i + 1) * size));
      copy("v", v.subarray(i * size, (i + 1) * size));
      module.exports.energy(work, work);
      [found.kinetic[i], found.potential[i]] = module.view(work + 8 * places.energy, 2);
      if (!wanted.length && !found.forces.length && !accelerations && !rubs) continue;
      module.exports.accelerations(work, work);
      if (rubs) found.friction[i] = module.view(work + 8 * places.friction_power, 1)[0];
      found.a?.set(module.view(work + 8 * places.a, size), i * size);
      for (const {driver, place} of wanted) found.efforts[driver][i] = module.view(work + 8 * (places.x0 + place), 1)[0];
      if (found.forces.length) found.forces.set(this.forces(module.view(work, module.module.size), places), 2 * i * data.forces.length);
    }
    return found;
  }
  /** `measure` for a run with events: each part of the run, in one mode, by itself. */
  measureParts(parameters, {ts, q, v, count, modes}, efforts, forces) {
    const n = this.size, numbers = this.numbers(parameters), parts = [];
    for (let from = 0, to = 0; from < count; from = to) {
      while (to < count && modes[to] === modes[from]) to++;
      const part = {ts: ts.subarray(from, to), q: q.subarray(from * n, to * n), v: v.subarray(from * n, to * n), count: to - from, mode: modes[from]};
      part.marks = this.markRows(this.inMode(numbers, part.mode), {t: ts[from], q: part.q.subarray(0, n), v: part.v.subarray(0, n)});
      parts.push(this.measure(parameters, part, efforts, forces));
    }
    const joined = of => Float64Array.from(parts.flatMap(part => [...of(part)]));
    return {kinetic: joined(p => p.kinetic), potential: joined(p => p.potential),
      efforts: Object.fromEntries(Object.keys(parts[0].efforts).map(name => [name, joined(p => p.efforts[name])])),
      friction: parts[0].friction && joined(p => p.friction),
      forces: joined(p => (parts.every(({forces}) => forces.length) ? p.forces : []))};
  }
  /** Forces x, y of each joint at the last evaluated state. */
  forces(work, {x0, psi_q}) {
    const sum = terms => terms.reduce((total, [i, j, factor]) => total + work[x0 + i] * (j === null ? 1 : work[psi_q + j]) * factor, 0);
    return this.data.forces.flatMap(({x, y}) => [sum(x), sum(y)]);
  }
}
/** The engine of a mechanism, from its data. */
async function loadEngine(data) {
  if (data.format !== 2) throw new Error(`this engine reads format 2, not ${data.format}`);
  const loaded = Object.entries(data.modules).map(async ([name, module]) => [name, await Instance.load(module)]);
  const engine = new Engine(data, Object.fromEntries(await Promise.all(loaded)));
  return engine;
}
/** Updates the symbols, marks and traces of a run from the numbers of the scene. */
class SymbolUpdater {
  constructor(run, rows) {
    this.run = run;
    this.rows = rows;
    run.symbols = structuredClone(run.symbols);
    run.marks = structuredClone(run.marks);
    run.traces = structuredClone(run.traces);
    run.arrows = structuredClone(run.reactions);
    run.placed = run.measures.map(measure => structuredClone(measure.anchors));
    this.whole = rows.sizes.map(([k]) => structuredClone(run.symbols[k]));
  }
  update(numbers) {
    const {run, rows} = this, put = (anchor, start, x, y) => { anchor[start] = numbers[x]; anchor[start + 1] = numbers[y]; };
    for (const [k, which, x, y] of rows.frames) put(which < 0 ? run.symbols[k].frame : run.symbols[k].frame[which], 1, x, y);
    for (const [k, row, x, y] of rows.points) put(run.symbols[k].points[row], 0, x, y);
    for (const [k, , x, y] of rows.traces) put(run.traces[k], 1, x, y);
    for (const [k, , x, y] of rows.arrows) put(run.arrows.anchors[k], 1, x, y);
    for (const [k, which, x, y] of rows.measures ?? []) put(run.placed[k][which], 1, x, y);
    for (const [k, , x, y] of rows.pins) run.marks[k].at = [numbers[x], numbers[y]];
    for (const [k, place] of rows.angles) run.symbols[k].frame[3] = numbers[place];
    rows.sizes.forEach(([k, place, radius], i) => {
      const scale = numbers[place] / radius, {points, radius: size} = this.whole[i];
      if (points) run.symbols[k].points = points.map(([x, y, ...rest]) => [x * scale, y * scale, ...rest]);
      if (size) run.symbols[k].radius = [size[0] * scale, size[1], size[2]];
    });
    run.paths = null;
  }
}
const SWING = 2 * Math.PI * 1.5;  // rad per second of real time: natural frequency of the spring with half of all masses
const DAMPING = 0.7;  // damping ratio
const LONGEST_FRAME = 0.05;  // s of real time: in longer frames the motion lags
/** Pulls until it is released; `live` is the run, which has the engine and shows the motion. */
class Hand {
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
function bodyAt(painter, symbols, [x, y], reach) {
  for (const symbol of [...symbols].reverse()) {
    const {frame} = symbol;
    if (frame.length === 2 || frame[0] < 0 || !painter.holds(symbol, x, y, reach)) continue;
    const body = frame[0], {pose, view} = painter, angle = pose[3 * body + 2];
    const dx = (x - view.x) / view.scale - pose[3 * body], dy = (view.y - y) / view.scale - pose[3 * body + 1];
    return {body, point: [Math.cos(angle) * dx + Math.sin(angle) * dy, Math.cos(angle) * dy - Math.sin(angle) * dx]};
  }
  return null;
}
const STEPS = 500;  // key presses over the range of a slider
const DIGITS = 5;  // significant digits of a number
/** The panel of sliders and buttons; `changed(k, value)` is called while slider k moves, and an action when its button is pressed. */
class SliderPanel {
  constructor(sliders, changed, actions) {
    this.sliders = sliders;
    this.rows = sliders.map((slider, k) => this.row(slider, value => changed(k, value)));
    this.note = make("p", {class: "note", role: "status"});
    const sections = Map.groupBy ? Map.groupBy(this.rows, r => r.slider.section) : grouped(this.rows);
    const parts = [...sections].map(([title, rows], k) => {
      const part = make("details", {}, make("summary", {}, title), ...rows.map(r => r.element));
      part.open = k < 1 || sections.size < 3 || this.rows.length < 9;
      return part;
    });
    this.buttons = Object.fromEntries(Object.entries(actions).map(([name, {words, title, act}]) => [name,
      make("button", {type: "button", title, onclick: act}, words)]));
    this.element = make("aside", {class: "live", "aria-label": "numbers of the scene"},
      make("div", {class: "actions"}, ...Object.values(this.buttons)), this.note, make("div", {class: "rows"}, ...parts));
  }
  row(slider, changed) {
    const {label, low, high, shown: unit = slider.unit, per_unit: per = 1} = slider, step = (high - low) / STEPS;
    const range = make("input", {type: "range", min: low, max: high, step, "aria-label": label, "aria-valuetext": `${slider.value * per} ${unit}`});
    const number = make("input", {type: "number", step: "any", "aria-label": `${label}, number`});
    const set = value => {
      if (value < +range.min) range.min = value;
      if (value > +range.max) range.max = value;
      range.value = value;
      number.value = +(value * per).toPrecision(DIGITS);
      range.setAttribute("aria-valuetext", `${number.value} ${unit}`);
    };
    range.addEventListener("input", () => { set(+range.value); changed(+range.value); });
    let taken = null;  // the last text that was taken
    const take = () => {
      if (!Number.isFinite(number.valueAsNumber)) return set(+range.value);
      if (number.value === taken) return undefined;
      const value = number.valueAsNumber / per;
      set(value);
      taken = number.value;
      return changed(value);
    };
    number.addEventListener("focus", () => { taken = number.value; });
    number.addEventListener("change", take);
    number.addEventListener("keydown", event => { if (event.key === "Enter") take(); });  // a notebook keeps Enter from causing a change event
    range.addEventListener("dblclick", () => { set(slider.value); changed(slider.value); });
    const words = unit.replaceAll("m2", "m²").replaceAll("s2", "s²").replaceAll("m3", "m³").replaceAll(" ", "·");
    const element = make("div", {class: "slider", title: slider.name},
      make("span", {class: "name"}, label), number, make("span", {class: "unit"}, words), range);
    set(slider.value);
    return {slider, element, set, range, number};
  }
  show(values) {
    values.forEach((value, k) => this.rows[k].set(value));
  }
  say(words, bad = false) {
    this.note.textContent = words;
    this.note.classList.toggle("bad", bad);
  }
  enable(on) {
    for (const input of this.element.querySelectorAll("input, button")) input.disabled = !on;
  }
}
function grouped(rows) {
  const found = new Map();
  for (const row of rows) found.set(row.slider.section, [...(found.get(row.slider.section) ?? []), row]);
  return found;
}
const LIVE_STYLE = `
.middle { display: flex; min-height: 0; }
.fill .middle { flex: 1; }
.middle .stage { flex: 1; min-width: 0; }
.live { width: 300px; flex: none; display: flex; flex-direction: column; min-height: 0; background: var(--panel);
  border-left: 1px solid var(--line); font-size: 13px; }
.live .actions { display: flex; gap: 4px; flex-wrap: wrap; padding: 6px 10px; border-bottom: 1px solid var(--line); }
.live .note { margin: 0; padding: 7px 14px; color: var(--soft); min-height: 34px; white-space: pre-line; border-bottom: 1px solid var(--line); }
.live .note.bad { color: var(--force); font-weight: 600; }
.live .rows { overflow: auto; flex: 1; min-height: 0; padding: 4px 14px 14px; }
.live summary { cursor: pointer; font-weight: 600; padding: 8px 0 4px; }
.live .slider { display: grid; grid-template-columns: minmax(0, 1fr) 84px 48px; align-items: center; gap: 0 6px; padding: 4px 0 2px; }
.live .name { overflow-wrap: anywhere; }
.live .unit { color: var(--soft); }
.live .slider input[type="range"] { grid-column: 1 / -1; width: 100%; height: 24px; }
.live input[type="number"] { font: inherit; font-variant-numeric: tabular-nums; width: 100%; height: 26px; padding: 0 4px; text-align: right;
  color: var(--ink); background: var(--back); border: 1px solid var(--line); border-radius: 5px; appearance: textfield; }
.live input::-webkit-inner-spin-button { appearance: none; margin: 0; }
.live :disabled { opacity: 0.5; cursor: default; }
.narrow .middle { flex-direction: column; }
.narrow .live { width: auto; border-left: 0; border-top: 1px solid var(--line); max-height: 40%; }
.fill.narrow .live { flex: 0 1 38%; }
.panel canvas.holds { cursor: pointer; }
@media (pointer: coarse) { .live .slider input[type="range"] { height: 34px; } .live input[type="number"] { height: 34px; } }
`;
class Address {
  constructor(live) { this.live = live; }
  /** True if the page has an address of its own, and is not inside another page. */
  get exists() { return Boolean(this.live.player.options.fill) && location.protocol !== "about:"; }
  /** The changed numbers, as the fragment of an address. */
  get fragment() {
    const {data: {sliders}, values} = this.live, changed = sliders.map((s, k) => [s, values[k]]).filter(([s, x]) => x !== s.value);
    return new URLSearchParams(changed.map(([s, x]) => [s.name, String(x)])).toString();
  }
  write() {
    if (this.exists) history.replaceState(null, "", `#${this.fragment}`);
  }
  read() {
    if (!this.exists) return;
    const given = new URLSearchParams(location.hash.slice(1)), numbers = {};
    for (const {name} of this.live.data.sliders) {
      const value = Number(given.get(name));
      if (given.get(name) && Number.isFinite(value)) numbers[name] = value;
    }
    if (Object.keys(numbers).length) this.live.change(numbers);
  }
  async copy() {
    const {live, fragment} = this;
    this.write();
    try {
      await navigator.clipboard.writeText(this.exists ? location.href : `#${fragment}`);
      live.say("A link with these numbers has been copied.");
    } catch {
      live.say(this.exists ? "The address of this page now contains these numbers." : `Changed numbers: ${fragment || "none"}`);
    }
  }
}
const HOPELESS = 1e3;  // times the largest number of steps: a run that would need more at the pace of a part has come to a standstill
const STANDSTILL = "its steps become ever smaller, as where a motor asks for more than the linkage can reach";
class PartRun {
  /** The run of `engine` from a closed state over `times`, with the numbers `values`. */
  constructor(engine, values, state, times) {
    const T = times.length, n = engine.size;
    const run = {ts: times.slice(), q: new Float64Array(T * n), v: new Float64Array(T * n), violation: new Float64Array(T), modes: engine.data.events ? Array(T).fill(null) : null, count: 0, events: []};
    Object.assign(this, {engine, values, state, run, steps: 0, tried: 0, t: times[0], goesOn: true, stands: false, done: false, stop: null, words: ""});
  }
  get most() { return this.engine.data.settings.max_steps; }
  /** The part of the span that has been computed, from 0 to 1. */
  get share() {
    const {ts} = this.run;
    return (this.t - ts[0]) / (ts[ts.length - 1] - ts[0]);
  }
  /** Integrate by at most `steps` steps; returns whether the run goes on. If not, `done` is false if it ended early, for the reason
   *  `words`; `stop` is the reason if an event ended it. */
  goOn(steps) {
    const {engine, run, most} = this, n = engine.size, from = run.count, before = this.t;
    const times = from ? Float64Array.of(this.state.t, ...run.ts.subarray(from)) : run.ts, skip = from ? 1 : 0;
    const part = engine.run(this.values, this.state, times, null, Math.min(steps, most - this.tried)), count = Math.max(part.count - skip, 0);
    run.ts.set(part.ts.subarray(skip, skip + count), from);
    run.q.set(part.q.subarray(skip * n, (skip + count) * n), from * n);
    run.v.set(part.v.subarray(skip * n, (skip + count) * n), from * n);
    run.violation.set(part.violation.subarray(skip, skip + count), from);
    if (run.modes) run.modes.splice(from, count, ...part.modes.slice(skip, skip + count));
    run.count = from + count;
    run.events.push(...part.events);
    this.steps += part.steps;
    this.tried += part.tried;
    Object.assign(this, {state: part.last, t: part.t, done: part.done, stop: part.stop ?? null, words: part.words});
    this.stands = part.limited && part.tried * (run.ts[run.ts.length - 1] - part.t) > HOPELESS * most * (part.t - before);
    if (this.stands) this.words = STANDSTILL;
    this.goesOn = part.limited && !this.stands && this.tried < most;
    return this.goesOn;
  }
}
/** The measure at each time of a run of `size` coordinates: m/s, or degrees; empty without anchors. */
function placedValues({ts, q, v}, size, anchors) {
  if (!anchors.length) return [];
  return Float64Array.from(ts, (_, i) => {
    const now = q.subarray(i * size, (i + 1) * size), rates = v.subarray(i * size, (i + 1) * size);
    return anchors.length === 1 ? pinSpeed(now, rates, anchors[0]) : acuteAngle(...anchors.map(anchor => place(now, anchor)));
  });
}
function pinSpeed(now, rates, anchor) {
  const k = 3 * anchor[0], [x, y] = place(now, anchor);
  return Math.hypot(rates[k] - rates[k + 2] * (y - now[k + 1]), rates[k + 1] + rates[k + 2] * (x - now[k]));
}
function acuteAngle(a, corner, b) {
  const [ux, uy, wx, wy] = [a[0] - corner[0], a[1] - corner[1], b[0] - corner[0], b[1] - corner[1]];
  return 180 / Math.PI * Math.atan2(Math.abs(ux * wy - uy * wx), Math.abs(ux * wx + uy * wy));
}
const SMALLEST_POSITIVE = 1e-17;  // m: drawn instead of a zero violation on a logarithmic axis
const GHOST = 0.28;  // opacity of the first motion
const REACH = {mouse: 6, touch: 16};  // px around a body within which it can be grasped
const STEP_BYTES = 4e7;
const USUAL = 0.95;  // fraction of the instants without a force above the usual force, which scales the arrows
class LiveRun {
  /** `live` is the page; `run` is shown; `record` is its data, and `data` its further data for a live page. */
  constructor(live, run, record, data) {
    const {ts, q, v, measures, frame, reactions, forces, events, sticking} = run;
    Object.assign(this, {live, run, data, player: live.player, ghost: new Run(record), first: {ts, q, v, measures, frame, reactions, forces, events, sticking}});
    this.times = data.times ? Float64Array.from(data.times) : ts;  // all output times, even if the first motion failed or was stopped
    this.updater = new SymbolUpdater(run, data.symbol_updates);
    Object.assign(this, {changed: false, hand: null, job: null, marks: null});
  }
  use(engine) {
    this.engine = engine;
    this.steps = Math.round(STEP_BYTES / engine.data.modules.run.bytes);  // per frame
    this.firstFreedoms = this.freedoms(this.close(null), null);
  }
  /** The numbers of this run's sliders; sliders that were not moved have the run's own numbers. */
  get values() {
    const {values, data: {sliders}} = this.live;
    return Float64Array.from(this.data.sliders, ([k, own]) => (values[k] === sliders[k].value ? own : values[k]));
  }
  get end() { return this.run.ts[this.run.ts.length - 1]; }
  close(values) { return this.engine.close(values, {t: this.times[0], ...this.data.start}); }
  /** The degrees of freedom near a closed state, whose marks are set; null where branches of the motion meet. */
  freedoms(state, values) {
    this.marks = state.marks = this.engine.mark(values, state);
    const rank = this.marks?.reduce((sum, x) => sum + x, 0) ?? state.rank;
    return this.marks && state.rank < rank && this.marks.every((mark, row) => mark || !this.engine.holds(row)) ? null : this.engine.size - rank;
  }
  lengthOf(violation) { return `${(violation * this.engine.data.scales.length).toPrecision(2)} m`; }
  reset() {
    const {ts, q, v, measures, frame, reactions, forces, events} = this.first;
    this.drop();
    this.run.replace(ts, q, v, measures, frame, events);
    this.run.modes = null;
    this.run.sticking = this.first.sticking;
    this.showReactions(reactions, forces);
    this.updater.update(this.engine.numbers(null));
    this.changed = false;
  }
  /** Begin to simulate the motion with the current numbers; returns a message if its loops do not close. */
  begin() {
    this.drop();
    const {engine, times, values} = this, start = performance.now(), state = this.close(values);
    if (!state.closed) return `The loops do not close with these numbers: a gap of ${this.lengthOf(state.violation)} remains. The last valid motion is shown.`;
    const freedoms = this.freedoms(state, values);  // which marks the rows of the state
    this.job = {parts: new PartRun(engine, values, state, times), freedoms, start};
    this.updater.update(engine.numbers(values));
    return "";
  }
  /** Simulate as many steps as fit into one frame; returns the message, with `bad` for a motion that ended too early. */
  goOn() {
    const {job: {parts, freedoms, start}} = this, goesOn = parts.goOn(this.steps);
    this.show(parts.run);
    if (goesOn) return {words: `Simulating: ${Math.round(100 * parts.share)} %`, bad: false};
    this.job = null;
    const {run: {ts, events}, t, steps, done, words: reason} = parts, span = this.times[this.times.length - 1] - ts[0];
    const happened = events.length ? `, ${events.length} event${events.length > 1 ? "s" : ""}` : "";
    const ended = done ? `${+span.toPrecision(3)} s simulated in ${(performance.now() - start).toFixed(1)} ms, ${steps} steps${happened}.`
      : `The motion ends at ${t.toPrecision(4)} s: ${reason}.`;
    const first = this.firstFreedoms === null ? "" : `, ${this.firstFreedoms} in the first motion`;
    const words = freedoms === this.firstFreedoms || freedoms === null ? ended : `${ended} Degrees of freedom: ${freedoms}${first}.`;
    return {words, bad: !done && !parts.stop};
  }
  drop() {
    this.job = null;
    const {hand} = this;
    this.hand = null;
    if (hand) cancelAnimationFrame(hand.request);
  }
  show(run) {
    const {count} = run, n = this.engine.size, cut = (x, size) => x.subarray(0, count * size);
    const part = {...run, marks: this.marks, ts: cut(run.ts, 1), q: cut(run.q, n), v: cut(run.v, n), violation: cut(run.violation, 1)};
    const found = this.engine.measure(this.values, part, true, Boolean(this.first.reactions));
    this.run.replace(part.ts, part.q, part.v, this.measures(part, found), 1, this.named(run.events));
    this.run.modes = run.modes;
    this.run.sticking = this.stuck(part, this.run.events);
    this.showReactions(this.reactions(found.forces), found.forces);
    this.changed = true;
  }
  /** The joints that stick, with the spans of time in which they do: from their events, or else from output to output. */
  stuck({ts, modes}, events) {
    const {sticking = {}} = this.engine.data.events ?? {};
    return (this.first.sticking ?? []).map(joint => {
      const [lock, side] = sticking[joint.name], sticks = mode => Boolean(mode) && (mode.phase[lock] > 0.5 || mode.joints[side] > 0.5), changes = [];
      ts.forEach((t, k) => {
        const now = sticks(modes[k]), before = k > 0 && sticks(modes[k - 1]);
        if (now === before) return;
        const name = `${joint.name} ${now ? "sticks" : "slips"}`, event = events.findLast(e => e.name === name && e.t >= ts[k - 1] && e.t <= t);
        changes.push(event?.t ?? t);
      });
      if (changes.length % 2) changes.push(ts[ts.length - 1]);
      return {...joint, spans: Array.from({length: changes.length / 2}, (_, k) => changes.slice(2 * k, 2 * k + 2))};
    });
  }
  /** Events in the form in which they are shown, {t, name}. */
  named(events) {
    const names = this.engine.data.events?.names ?? [];
    return events.map(({t, index}) => ({t, name: names[index]}));
  }
  /** The arrows of forces computed in the page; null with redundant constraints, since forces are not unique. */
  reactions(forces) {
    const {first: {reactions}} = this, each = 2 * (reactions?.anchors.length ?? 0);
    if (!forces.length || !reactions) return null;
    const largest = Float64Array.from({length: forces.length / each}, (_, i) => {
      const now = forces.subarray(i * each, (i + 1) * each);
      return now.reduce((most, x, k) => (k % 2 ? most : Math.max(most, Math.hypot(x, now[k + 1]))), 0);
    }).sort();
    const usual = largest[Math.floor(USUAL * (largest.length - 1))] || largest[largest.length - 1];
    return usual > 0 ? {...this.run.arrows, usual} : null;
  }
  showReactions(reactions, forces) {
    Object.assign(this.run, {reactions, forces});
    const button = this.player.buttons.reactions;
    if (button) button.disabled = !this.player.runs.some(run => run.reactions);
  }
  /** The measures of a motion that the page computes, under the names of the recorded ones. */
  measures(run, found) {
    const {length} = this.engine.data.scales;
    const total = found.kinetic.map((x, k) => x + found.potential[k]), change = total.map(x => x - total[0]);
    const efforts = Object.entries(found.efforts).flatMap(([name, x]) => [[`torque of ${name}`, x], [`force of ${name}`, x]]);
    const known = {"violation": run.violation.map(x => Math.max(x * length, SMALLEST_POSITIVE)), "energy change": change,
      "work of drivers and loads": change, "kinetic energy": found.kinetic, "potential energy": found.potential,
      "power of friction": found.friction ?? [], ...Object.fromEntries(efforts)};
    return this.first.measures.map((m, k) => ({...m, values: known[m.name] ?? placedValues(run, this.engine.size, this.run.placed[k] ?? [])}));
  }
  /** The state at the time shown. */
  stateNow() {
    const t = this.player.t, {q, v} = this.run.state(t);
    return {...this.engine.close(this.values, {t, q, v}), t};
  }
  /** The body at a pixel of a panel's canvas, if it can be grasped. */
  bodyAt(canvas, point, pointer = "mouse") {
    if (!this.engine) return null;
    const painter = this.player.painter(canvas);
    painter.pose = this.run.pose(this.player.t);
    return bodyAt(painter, this.run.symbols, point, REACH[pointer] ?? REACH.touch);
  }
  grasp(canvas, point, pointer) {
    const held = this.bodyAt(canvas, point, pointer);
    if (!held) return false;
    this.live.finish();
    this.player.pause();
    this.hand = new Hand(this, held, this.metres(canvas, point));
    return true;
  }
  move(canvas, point) { this.hand?.move(this.metres(canvas, point)); }
  release() {
    const {hand} = this;
    this.hand = null;
    hand?.release();
  }
  metres(canvas, [x, y]) {
    const view = this.player.view(canvas.clientWidth, canvas.clientHeight);
    return [(x - view.x) / view.scale, (view.y - y) / view.scale];
  }
  /** Begin the record of a pull with the motion up to now. */
  record(state) {
    const {ts, q, v} = this.run, n = this.engine.size, count = ts.findIndex(t => t >= state.t), before = count < 0 ? ts.length : count;
    const modes = this.modesBefore(before), old = this.run.measures.find(m => m.name === "violation")?.values, {length} = this.engine.data.scales;
    this.past = {ts: [...ts.slice(0, before)], q: [...q.slice(0, before * n)], v: [...v.slice(0, before * n)],
      violation: Array.from({length: before}, (_, k) => (old?.[k] ?? 0) / length), modes: Array.from({length: before}, (_, k) => modes?.[k] ?? null)};
    this.happened = this.run.events.filter(({t}) => t <= state.t);
    this.marks = state.marks ??= this.engine.mark(this.values, state);
    this.append(state, state.violation, []);
  }
  /** The modes of the first outputs of the motion; of a recorded motion they are computed. */
  modesBefore(count) {
    const {run: {modes, ts}, engine, values} = this;
    if (modes || !engine.data.events || count < 2) return modes;
    return engine.run(values, this.close(values), ts.subarray(0, count)).modes;
  }
  /** Add a state, and the events before it, to the record, and show it. */
  append({t, q, v, mode = null}, violation, events) {
    const {past} = this;
    this.happened.push(...this.named(events));
    past.ts.push(t);
    past.q.push(...q);
    past.v.push(...v);
    past.violation.push(violation);
    past.modes.push(mode);
    this.showPast();
    this.player.setEnd(Math.max(t, this.player.data.end));
    this.player.t = t;
    this.player.draw();
  }
  showPast() {
    const {modes, ...numbers} = this.past, run = Object.fromEntries(Object.entries(numbers).map(([name, x]) => [name, Float64Array.from(x)]));
    run.modes = this.engine.data.events ? modes : null;
    this.show({...run, count: run.ts.length, events: []});
    this.run.events = this.happened;
  }
  /** Continue the simulation after a pull, for the duration of the first motion. */
  letGo(state) {
    const {engine, past} = this, n = engine.size, times = this.times.map(t => t - this.times[0] + state.t);
    const run = engine.run(this.values, state, times);
    for (let k = 1; k < run.count; k++) {
      past.ts.push(run.ts[k]);
      past.q.push(...run.q.subarray(k * n, (k + 1) * n));
      past.v.push(...run.v.subarray(k * n, (k + 1) * n));
      past.violation.push(run.violation[k]);
      past.modes.push(run.modes?.[k] ?? null);
    }
    this.happened.push(...this.named(run.events));
    this.showPast();
    this.player.setEnd(this.live.end);
    const ended = `Released: the motion ends at ${run.t.toPrecision(4)} s: ${run.words}.`;
    this.live.say(run.done ? "Released: the motion continues by itself." : ended, !run.done && !run.stop);
    this.player.play();
  }
  paintGhost(painter, context, t) {
    if (!this.changed || !this.player.show.ghost) return;
    painter.pose = this.ghost.pose(Math.min(t, this.first.ts[this.first.ts.length - 1]));
    context.globalAlpha = GHOST;
    painter.draw(this.ghost.symbols);
    context.globalAlpha = 1;
  }
  paintHand(painter) {
    const {hand} = this;
    if (!hand) return;
    const from = painter.px(place(painter.pose, [hand.held.body, ...hand.held.point])), to = painter.px(hand.target);
    painter.line([from, to], 1.6, painter.theme.accent, {dash: [5, 3]});
    painter.circle(from, 3.2 * painter.pt, {fill: painter.theme.accent});
    painter.circle(to, 6 * painter.pt, {stroke: painter.theme.accent, width: 1.6});
  }
  /** Left, bottom, right, top (m) of everything drawn in the current motion. */
  bounds() { return boundsOf(this.run, 0.1 * this.engine.data.scales.length); }
}
const SETTLED = 150;  // ms without a change before the numbers are written to the address
class Live {
  constructor(player, data) {
    Object.assign(this, {player, data: data.live, firstEnd: data.end, dirty: false});
    this.values = Float64Array.from(this.data.sliders, s => s.value);
    this.runs = player.runs.map((run, k) => new LiveRun(this, run, data.runs[k], this.data.runs[k]));
    this.panel = new SliderPanel(this.data.sliders, (k, value) => this.set(k, value), {
      ghost: {words: "First motion", title: "show the first motion as well (G)", act: () => player.toggle("ghost")},
      reset: {words: "Reset", title: "back to the first motion (Backspace)", act: () => this.reset()},
      share: {words: "Copy link", title: "copy a link with these numbers", act: () => this.address.copy()},
    });
    player.show.ghost = true;
    player.buttons.ghost = this.panel.buttons.ghost;
    this.address = new Address(this);
    this.panel.enable(false);
    this.ready = this.load();
  }
  async load() {
    try {
      if (typeof WebAssembly === "undefined" || typeof DecompressionStream === "undefined") throw new Error("no WebAssembly");
      const engines = await Promise.all(this.data.engines.map(loadEngine));
      for (const run of this.runs) run.use(engines[run.data.engine]);
    } catch (error) {
      this.say(`This browser cannot simulate (${error.message}): the page plays the recorded motion.`, true);
      return false;
    }
    this.isReady = true;
    this.panel.enable(true);
    this.greet();
    this.address.read();
    return true;
  }
  get changed() { return this.runs.some(run => run.changed); }
  get isSolving() { return this.runs.some(run => run.job); }
  get end() { return Math.max(...this.runs.map(run => run.end)); }
  keys() {
    return {g: () => this.player.toggle("ghost"), Backspace: () => this.isReady && this.reset()};
  }
  greet() { this.say(`Move a slider or drag a body: the ${this.runs.length > 1 ? "motions are" : "motion is"} simulated again.`); }
  say(words, bad = false) { this.panel.say(words, bad); }
  set(k, value) {
    this.values[k] = value;
    this.solveSoon();
    clearTimeout(this.settling);
    this.settling = setTimeout(() => this.address.write(), SETTLED);
  }
  /** Change numbers by the names of their parameters, and simulate at once. */
  change(numbers) {
    this.data.sliders.forEach(({name}, k) => { if (name in numbers) this.values[k] = numbers[name]; });
    this.panel.show(this.values);
    this.solve();
  }
  reset() {
    cancelAnimationFrame(this.request);
    this.dirty = false;
    this.values = Float64Array.from(this.data.sliders, s => s.value);
    this.panel.show(this.values);
    for (const run of this.runs) run.reset();
    this.player.setEnd(this.firstEnd);
    this.address.write();
    this.greet();
    this.player.draw();
  }
  /** Simulate before the next frame, once for all changes until then. */
  solveSoon() {
    if (this.dirty) return;
    this.dirty = true;
    cancelAnimationFrame(this.request);  // a simulation in progress has the old numbers
    this.request = requestAnimationFrame(() => this.solve());
  }
  solve() {
    cancelAnimationFrame(this.request);
    this.dirty = false;
    this.said = this.runs.map(run => ({words: run.begin(), bad: true}));
    if (this.isSolving) this.player.setEnd(Math.max(...this.runs.map(run => (run.job ? run.times[run.times.length - 1] : run.end))));
    this.goOn();
  }
  /** Continue the simulation for one frame, and so on until the end. */
  goOn() {
    this.runs.forEach((run, k) => { if (run.job) this.said[k] = run.goOn(); });
    const several = this.said.length > 1, words = this.said.map((said, k) => (several ? `${this.player.runs[k].label}: ` : "") + said.words);
    this.say(words.join("\n"), this.said.some(said => said.bad));
    if (this.isSolving) this.request = requestAnimationFrame(() => this.goOn());
    else this.player.setEnd(this.end);  // a motion may end early
    this.player.draw();
  }
  /** Complete all simulations at once. */
  finish() {
    if (this.dirty) this.solve();
    cancelAnimationFrame(this.request);
    while (this.isSolving) this.goOn();
    cancelAnimationFrame(this.request);
  }
  /** Set the bounds of the view to those of the current motions. */
  fit() {
    const {bounds} = this.player.data, all = this.runs.map(run => run.bounds());
    this.firstBounds ??= bounds.slice();
    bounds.splice(0, 4, ...(this.changed ? [0, 1, 2, 3].map(k => Math[k < 2 ? "min" : "max"](...all.map(one => one[k]))) : this.firstBounds));
  }
}
class Player {
  constructor(element, data, options) {
    if (data.format !== 1) throw new Error(`this player reads format 1, not ${data.format}`);
    this.data = data;
    this.options = options;
    this.runs = data.runs.map(record => new Run(record));
    this.modes = this.runs.some(run => run.mode);
    this.t = data.start;
    this.playing = false;
    this.speed = data.speed;
    this.amplitude = 1;
    this.show = {traces: !this.modes, names: false, reactions: this.runs.some(run => run.reactions), loop: true};
    this.zoom = {factor: 1, x: 0, y: 0};
    this.measures = [...new Set(this.runs.flatMap(run => run.measures.map(m => m.name)))];
    this.measure = this.measures[0];
    this.listeners = [];
    this.media = matchMedia("(prefers-color-scheme: dark)");
    this.chosen = options.theme ?? null;
    this.build(element);
    this.onMedia = () => this.retheme();
    this.media.addEventListener("change", this.onMedia);
    this.resize = new ResizeObserver(() => this.layout());
    this.resize.observe(this.root);
    this.retheme();
    this.layout();
    if (options.autoplay && !matchMedia("(prefers-reduced-motion: reduce)").matches) this.play();
  }
  build(element) {
    const {data} = this, shadow = element.shadowRoot ?? element.attachShadow({mode: "open"});
    const toggle = (name, words, key) => button(words, `${words} (${key})`, () => this.toggle(name));
    this.playButton = make("button", {class: "icon primary", type: "button", onclick: () => this.toggle("playing")});
    this.timeLabel = make("span", {class: "time"});
    this.scrub = make("input", {class: "scrub", type: "range", min: 0, max: 10000, step: 1, "aria-label": "time",
      oninput: () => this.seek(data.start + (data.end - data.start) * this.scrub.value / 10000)});
    this.speedSelect = make("select", {"aria-label": "speed", title: "speed (+ −)", onchange: () => this.setSpeed(+this.speedSelect.value)});
    const near = SPEEDS.filter(s => s >= 0.009 * this.speed && s <= 21 * this.speed);
    for (const s of [...new Set([...near, this.speed])].sort((a, b) => a - b)) {
      this.speedSelect.append(make("option", {value: s}, `${s} ×`));
    }
    this.speedSelect.value = this.speed;
    this.buttons = {loop: button(icon("loop"), "repeat (L)", () => this.toggle("loop"), "icon")};
    if (this.runs.some(run => run.traces.length)) this.buttons.traces = toggle("traces", "Traces", "T");
    if (this.runs.some(run => run.reactions)) this.buttons.reactions = toggle("reactions", "Reactions", "R");
    this.buttons.names = toggle("names", "Names", "N");
    this.gaps = this.runs.some(run => run.gaps) ? new GapMarks(this) : null;
    this.panels = this.runs.map((run, k) => this.panel(run, k));
    this.stage = make("div", {class: "stage"}, ...this.panels.map(p => p.figure));
    this.live = data.live ? new Live(this, data) : null;
    const middle = this.live ? make("div", {class: "middle"}, this.stage, this.live.panel.element) : this.stage;
    this.help = make("div", {class: "help", hidden: "", onclick: () => this.toggleHelp()},
      make("dl", {}, ...[...HELP, ...(data.live ? LIVE_HELP : []), ...(this.gaps ? [["G", "least gap"]] : [])].flatMap(([key, words]) => [make("dt", {}, key), make("dd", {}, words)])));
    this.eventMarks = new EventMarks(this);
    const groups = [this.playButton, this.timeLabel, this.eventMarks.element, make("div", {class: "group"}, ...(this.modes ? [] : [this.speedSelect]),
      ...Object.entries(this.buttons).filter(([name]) => name !== "ghost").map(([, button]) => button), ...(this.gaps ? [this.gaps.button] : []))];
    if (this.modes) {
      const range = make("input", {type: "range", min: 0, max: 3, step: 0.01, value: 1, "aria-label": "amplitude",
        oninput: () => { this.amplitude = +range.value; this.draw(); }});
      groups.push(make("label", {class: "amplitude"}, "amplitude", range));
    }
    this.root = make("div", {class: "player", tabindex: -1},
      make("header", {}, make("h1", {title: data.title}, data.title),
        button(icon("theme"), "switch between dark and light (D)", () => this.switchTheme(), "icon"),
        button("?", "keyboard shortcuts (?)", () => this.toggleHelp(), "icon")),
      middle, ...(this.measures.length ? [this.strip()] : []), make("div", {class: "controls"}, ...groups), this.help);
    this.keys = this.options.fill ? window : this.root;  // a filled window has no other use of keys
    this.onKey = event => this.key(event);
    this.keys.addEventListener("keydown", this.onKey);
    keepKeys(this.root, this.panels[0].canvas);
    this.root.classList.toggle("fill", Boolean(this.options.fill));
    shadow.replaceChildren(make("style", {}, STYLE + (data.live ? LIVE_STYLE : "")), this.root);
    for (const name of Object.keys(this.buttons)) this.press(name);
    this.setPlaying(false);
  }
  panel(run, k) {
    const canvas = make("canvas", {role: "img", tabindex: 0, "aria-label": `${this.data.title} ${run.label}: motion`});
    const note = make("span", {}, run.note ? ` ${run.note}` : ""), happened = make("div", {class: "happened"});
    const caption = make("figcaption", {}, ...(this.runs.length > 1 || this.modes ? [make("b", {}, run.label)] : []), note, happened);
    const panel = {run, canvas, note, happened, figure: make("figure", {class: "panel"}, canvas, caption)};
    followPointers(this, canvas, () => this.live?.runs[k]);
    return panel;
  }
  strip() {
    this.stripCanvas = make("canvas", {"aria-hidden": "true"});
    const select = this.measureSelect = make("select", {"aria-label": "measure", onchange: () => { this.measure = select.value; this.draw(); }});
    for (const name of this.measures) select.append(make("option", {value: name}, name));
    const seek = event => {
      const box = this.stripCanvas.getBoundingClientRect();
      this.seek(this.data.start + (this.data.end - this.data.start) * stripPart(event.clientX - box.left, box.width));
    };
    this.stripCanvas.addEventListener("pointerdown", event => { this.stripCanvas.setPointerCapture(event.pointerId); seek(event); });
    this.stripCanvas.addEventListener("pointermove", event => { if (event.buttons) seek(event); });
    return make("div", {class: "strip"}, this.stripCanvas, select);
  }
  zoomAt(canvas, x, y, factor) {
    const next = clamp(this.zoom.factor * factor, 0.2, 100), ratio = next / this.zoom.factor;
    const cx = canvas.clientWidth / 2, cy = canvas.clientHeight / 2;
    this.zoom.x = (this.zoom.x + cx - x) * ratio + x - cx;
    this.zoom.y = (this.zoom.y + cy - y) * ratio + y - cy;
    this.zoom.factor = next;
  }
  whole() {
    this.zoom = {factor: 1, x: 0, y: 0};
    this.live?.fit();
    this.draw();
  }
  on(listener) {
    this.listeners.push(listener);
  }
  notify() {
    for (const listener of this.listeners) listener(this);
  }
  toggle(name) {
    if (name === "playing") return this.playing ? this.pause() : this.play();
    this.show[name] = !this.show[name];
    this.press(name);
    this.draw();
  }
  press(name) {
    this.buttons[name]?.setAttribute("aria-pressed", this.show[name]);
  }
  setPlaying(playing) {
    this.playing = playing;
    const words = playing ? "pause (space)" : "play (space)";
    this.playButton.replaceChildren(icon(playing ? "pause" : "play"));
    this.playButton.title = words;
    this.playButton.setAttribute("aria-label", words);
  }
  setSpeed(speed) {
    this.speed = speed;
    this.speedSelect.value = speed;
  }
  play() {
    if (this.playing) return;
    if (this.t >= this.data.end) this.t = this.data.start;
    this.setPlaying(true);
    let before = null;
    const frame = now => {
      if (!this.playing) return;
      this.advance(before === null ? 0 : Math.min(now - before, 250) / 1000);
      before = now;
      this.request = requestAnimationFrame(frame);
    };
    this.request = requestAnimationFrame(frame);
    this.notify();
  }
  /** Set the end of the timeline. */
  setEnd(end) {
    this.data.end = end;
    this.t = Math.min(this.t, end);
  }
  advance(seconds) {
    const {start, end} = this.data;
    let t = this.t + seconds * this.speed;
    if (t >= end && this.show.loop && end > start) t = start + (t - start) % (end - start);
    this.t = Math.min(t, end);
    this.draw();
    if (this.t >= end) this.pause();
  }
  pause() {
    if (!this.playing) return;
    cancelAnimationFrame(this.request);
    this.setPlaying(false);
    this.notify();
  }
  seek(t) {
    this.t = clamp(t, this.data.start, this.data.end);
    this.draw();
    this.notify();
  }
  switchTheme() {
    this.chosen = this.themeName() === "dark" ? "light" : "dark";
    this.retheme();
  }
  themeName() {
    return this.chosen ?? (this.media.matches ? "dark" : "light");
  }
  retheme() {
    this.theme = THEMES[this.themeName()];
    const {back, panel, ink, soft, line, accent, onAccent, force} = this.theme;
    const colours = {back, panel, ink, soft, line, accent, force, "on-accent": onAccent};
    for (const [name, value] of Object.entries(colours)) this.root.style.setProperty(`--${name}`, value);
    this.root.style.colorScheme = this.themeName();
    if (this.options.fill) document.body.style.background = back;
    this.draw();
  }
  toggleHelp() {
    this.help.hidden = !this.help.hidden;
  }
  key(event) {
    const [target] = event.composedPath();
    if (event.ctrlKey || event.metaKey || event.altKey || ["SELECT", "INPUT"].includes(target.tagName) && target !== this.scrub) return;
    const {start, end} = this.data, step = event.shiftKey ? (end - start) / 20 : this.speed / 30;
    const speeds = [...this.speedSelect.options].map(o => +o.value), at = speeds.indexOf(this.speed);
    const actions = {
      " ": () => this.toggle("playing"), ArrowLeft: () => this.seek(this.t - step), ArrowRight: () => this.seek(this.t + step),
      Home: () => this.seek(start), End: () => this.seek(end), 0: () => this.whole(), "?": () => this.toggleHelp(),
      "+": () => this.setSpeed(speeds[Math.min(at + 1, speeds.length - 1)]), "-": () => this.setSpeed(speeds[Math.max(at - 1, 0)]),
      t: () => this.toggle("traces"), n: () => this.toggle("names"), r: () => this.toggle("reactions"), l: () => this.toggle("loop"),
      d: () => this.switchTheme(), ...(this.live?.keys() ?? {}), ...(this.gaps ? {g: this.gaps.show} : {}), Escape: () => { this.help.hidden = true; },
    };
    const action = actions[event.key] ?? actions[event.key.toLowerCase()];
    if (!action || (event.key === " " && ["BUTTON", "SUMMARY"].includes(target.tagName))) return;  // a button takes the space bar itself
    event.preventDefault();
    action();
  }
  layout() {
    const width = this.root.clientWidth;
    if (!width) return;
    this.root.classList.toggle("narrow", width < 640);
    if (!this.options.fill) {
      const [left, bottom, right, top] = this.data.bounds, narrow = width < 640;
      const each = narrow ? width : width / this.runs.length, aspect = (top - bottom) / (right - left);
      const height = clamp(each * aspect + 60, 220, narrow ? 320 : 480);
      this.stage.style.height = `${Math.round(narrow ? height * this.runs.length : height)}px`;
    }
    this.draw();
  }
  /** The view of a panel: a place (X, Y) in metres is at the pixel (x + scale X, y - scale Y). */
  view(width, height) {
    const [left, bottom, right, top] = this.data.bounds;
    const margin = Math.min(44, 0.12 * Math.min(width, height));
    const fit = Math.min((width - 2 * margin) / (right - left), (height - 2 * margin) / (top - bottom));
    const scale = fit * this.zoom.factor;
    return {scale, x: width / 2 - scale * (left + right) / 2 + this.zoom.x, y: height / 2 + scale * (bottom + top) / 2 + this.zoom.y};
  }
  /** The painter of a panel's canvas. */
  painter(canvas, context = null) {
    const {clientWidth: width, clientHeight: height} = canvas, pt = clamp(Math.min(width, height) / 420, 0.75, 1.5);
    return new SymbolPainter(context, this.view(width, height), this.theme, pt, null);
  }
  draw() {
    if (!this.theme) return;
    const {data, t, theme, show} = this;
    this.panels.forEach(({run, canvas, note}, k) => {
      const live = this.live?.runs[k];
      note.hidden = Boolean(live?.changed);  // the note is about the first motion
      const {context, width, height} = contextOf(canvas);
      if (!width || !height) return;
      const painter = this.painter(canvas, context), step = painter.grid(width, height);
      live?.paintGhost(painter, context, t);
      if (show.traces && !run.mode) painter.traces(run, t);
      painter.pose = run.pose(t, this.amplitude);
      painter.draw(run.symbols);
      if (run.gaps) paintTouching(painter, run.gaps);
      painter.sticking(run, t);
      live?.paintHand(painter);
      if (show.reactions && run.reactions) painter.reactions(run, t, width, height);
      if (show.names) painter.names(run);
      painter.bar(step, height);
    });
    if (this.stripCanvas) {
      const {context, width, height} = contextOf(this.stripCanvas);
      drawStrip(context, width, height, this.runs, this.measure, data.start, data.end, t, theme, this.measureSelect.offsetWidth + 24);
    }
    this.eventMarks.draw();
    const span = data.end - data.start;
    this.scrub.value = span > 0 ? Math.round(10000 * (t - data.start) / span) : 0;
    const digits = clamp(3 - Math.floor(Math.log10(span || 1)), 0, 9), of = x => x.toFixed(digits);
    const [now, rest] = this.modes ? [`${Math.round(360 * t)}°`, ""] : [of(t), ` / ${of(data.end)} ${data.unit}`];
    this.timeLabel.replaceChildren(make("b", {}, now), rest);
    this.scrub.setAttribute("aria-valuetext", now + rest);
  }
  destroy() {
    this.pause();
    this.resize.disconnect();
    this.keys.removeEventListener("keydown", this.onKey);
    this.media.removeEventListener("change", this.onMedia);
    this.root.remove();
  }
}
/** Show `data` in an element.
 *
 *  options: fill (the whole window), theme ("light", "dark"; by default the preference of the system), autoplay.
 *  Returns an object with time, playing, play(), pause(), seek(t), speed, pixel(panel, x, y) -> [x, y] in the panel's canvas
 *  (CSS px), on(listener) and destroy(). The same object is the element's property `player`.
 */
function mount(element, data, options = {}) {
  const player = new Player(element, data, options);
  const handle = {
    get time() { return player.t; },
    get playing() { return player.playing; },
    get speed() { return player.speed; },
    set speed(speed) { player.setSpeed(speed); },
    play: () => player.play(),
    pause: () => player.pause(),
    seek: t => player.seek(t),
    pixel: (panel, x, y) => {
      const {clientWidth, clientHeight} = player.panels[panel].canvas, view = player.view(clientWidth, clientHeight);
      return [view.x + view.scale * x, view.y - view.scale * y];
    },
    get live() { return player.live; },
    on: listener => player.on(() => listener(handle)),
    destroy: () => player.destroy(),
  };
  element.player = handle;
  element.dataset.lmSuppressShortcuts = "true";  // so that JupyterLab's shortcuts do not intercept keys
  return handle;
}
/** anywidget: the model has `data`, and `time` (s) and `playing`, which are synchronized with the player. */
function render({model, el}) {
  const player = mount(el, model.get("data"), {theme: model.get("theme") || null});
  const seek = () => { if (Math.abs(model.get("time") - player.time) > 1e-9) player.seek(model.get("time")); };
  const play = () => (model.get("playing") ? player.play() : player.pause());
  player.on(({time, playing}) => {
    model.set("time", time);
    model.set("playing", playing);
    model.save_changes();
  });
  model.on("change:time", seek);
  model.on("change:playing", play);
  if (model.get("time") > player.time) seek();
  if (model.get("playing")) play();
  return () => {
    model.off("change:time", seek);
    model.off("change:playing", play);
    player.destroy();
  };
}


return mount;
})();
