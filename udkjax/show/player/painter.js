// Painting on a canvas: themes, lines and circles, arrows, texts, the grid, traces and reactions.

import {Labels, around, aroundPin} from "./labels.js";
import {clamp, nice, place, short} from "./motion.js";

// The Okabe-Ito colours, which colour-blind readers can distinguish, and one more; lighter in the dark theme.
export const THEMES = {
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
export function contrast(one, two) {
  const linear = x => (x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);
  const light = hex => [0.2126, 0.7152, 0.0722].reduce((sum, share, k) => sum + share * linear(part(hex, k) / 255), 0.05);
  const [a, b] = [light(one), light(two)];
  return Math.max(a, b) / Math.min(a, b);
}

/** A colour for text that is readable on all backgrounds of a theme: if needed, closer to its ink. */
export function readable(colour, {back, panel, ink}) {
  let found = colour;
  for (let t = 0; Math.min(contrast(found, back), contrast(found, panel)) < READABLE && t < 1; t += 0.05) found = mix(colour, ink, t);
  return found;
}

/** The mixture of two colours, with t from 0 to 1. */
export function mix(one, two, t) {
  return "#" + [0, 1, 2].map(k => Math.round(part(one, k) * (1 - t) + part(two, k) * t).toString(16).padStart(2, "0")).join("");
}

/** The cleared context of a canvas, in CSS pixels, at the resolution of the screen. */
export function contextOf(canvas) {
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
export class Painter {
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
