// A chart of several curves over time or over the angle of a motor, with numbers at its axes.

import {clamp, nice, short} from "./player/motion.js";
import {Painter, readable} from "./player/painter.js";

const LEFT = 58, RIGHT = 12, BOTTOM = 22;  // px around the curves
const TOPS = [40, 60], NAMES = [17, 48];  // px: the top of one curve and of several, and the middle of the line of their values
const TICKS = [7, 4];  // largest numbers of steps along and up
const EPS = 1e-12;

const widthOf = width => Math.max(width - LEFT - RIGHT, 1);

/** The value along the axis [low, high] at x (px) in a chart of a width. */
export const valueAt = (x, width, [low, high]) => low + (high - low) * clamp((x - LEFT) / widthOf(width), 0, 1);

/** The smallest and the largest of the finite values of curves, at least apart by rounding; null if there are none. */
export function rangeOf(curves) {
  let low = Infinity, high = -Infinity;
  for (const values of curves) for (const y of values) if (Number.isFinite(y)) { low = Math.min(low, y); high = Math.max(high, y); }
  if (!(high >= low)) return null;
  const least = EPS * Math.max(Math.abs(low), Math.abs(high)) || 1;
  return high - low < least ? [low - least / 2, high + least / 2] : [low, high];
}

/** Round values between two others, at most `most` steps apart. */
export function ticks([low, high], most) {
  const step = nice((high - low) / most), first = Math.ceil(low / step - EPS), found = [];
  for (let k = first; k * step <= high + EPS * step; k++) found.push(k * step);
  return found;
}

/** Draw curves {name, unit, values, now} over `along` {values, range, unit, now}; curves of one unit share their axis, which is that of
 *  the first curve; others are scaled to its height. */
export function drawChart(context, width, height, curves, along, theme, log = false) {
  const painter = new Painter(context, {x: 0, y: 0, scale: 1}, theme, 1, null), scaled = y => (log ? Math.log10(Math.max(Math.abs(y), 1e-300)) : y);
  const units = [...new Set(curves.map(({unit}) => unit))], bottom = height - BOTTOM, several = curves.length > 1 ? 1 : 0, top = TOPS[several];
  const ranges = new Map(units.map(unit => [unit, rangeOf(curves.filter(c => c.unit === unit).map(({values}) => Array.from(values, scaled)))]));
  if (!ranges.get(units[0])) return painter.text("no values for this motion", [width / 2, height / 2], theme.soft, {align: "center", halo: false});
  const x = value => LEFT + widthOf(width) * (value - along.range[0]) / (along.range[1] - along.range[0] || 1);
  const y = (value, [low, high]) => bottom - (bottom - top) * (scaled(value) - low) / (high - low), small = {size: 11, halo: false};
  for (const tick of ticks(ranges.get(units[0]), log ? 3 : TICKS[1])) {
    const at = bottom - (bottom - top) * (tick - ranges.get(units[0])[0]) / (ranges.get(units[0])[1] - ranges.get(units[0])[0]);
    painter.line([[LEFT, at], [width - RIGHT, at]], 1, theme.line);
    painter.text(log ? `1e${Math.round(tick)}` : short(+tick.toPrecision(9)), [LEFT - 6, at], theme.soft, {...small, align: "right"});
  }
  for (const tick of ticks(along.range, TICKS[0])) {
    painter.line([[x(tick), bottom], [x(tick), bottom + 4]], 1, theme.soft);
    painter.text(`${short(+tick.toPrecision(9))}${Math.abs(tick - along.range[1]) < EPS || tick === ticks(along.range, TICKS[0]).at(-1) ? ` ${along.unit}` : ""}`, [Math.min(x(tick), width - RIGHT - 14), bottom + 12], theme.soft, {...small, align: "center"});
  }
  curves.forEach(({values, unit}, k) => {
    const range = ranges.get(unit);
    if (!range) return;
    context.beginPath();
    let pen = false;
    for (let i = 0; i < Math.min(values.length, along.values.length); i++) {
      if (!Number.isFinite(values[i])) { pen = false; continue; }
      if (pen) context.lineTo(x(along.values[i]), y(values[i], range)); else context.moveTo(x(along.values[i]), y(values[i], range));
      pen = true;
    }
    context.lineWidth = 1.7;
    context.lineJoin = "round";
    context.strokeStyle = theme.bodies[k % theme.bodies.length];
    context.stroke();
  });
  painter.line([[x(along.now), top - 4], [x(along.now), bottom]], 1.2, theme.ink);
  let edge = width - RIGHT;
  [...curves.entries()].reverse().forEach(([k, {name, unit, now}]) => {
    const colour = theme.bodies[k % theme.bodies.length], words = `${curves.length > 1 ? `${name} ` : ""}${Number.isFinite(now) ? short(now) : "–"}${unit && ` ${unit}`}`;
    context.font = "600 12px system-ui";
    painter.text(words, [edge, NAMES[several]], readable(colour, theme), {align: "right", weight: 600, halo: false});
    if (Number.isFinite(now) && ranges.get(unit)) painter.circle([x(along.now), y(now, ranges.get(unit))], 3.4, {fill: colour, stroke: theme.panel});
    edge -= context.measureText(words).width + 18;
  });
  return undefined;
}
