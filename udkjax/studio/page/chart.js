// A chart of several curves over time or over the angle of a motor, with an axis for each unit, and the extremes of the last curve.

import {clamp, nice, short} from "./player/motion.js";
import {Painter, readable} from "./player/painter.js";

const LEFT = 58, RIGHT = 12, BOTTOM = 22;  // px around the curves
const AXIS = 50, MOST_AXES = 3, LEAST_WIDE = 180;  // px of each further axis; the most of them, and the least width that they leave to the curves
const OVER = {tops: [40, 60], names: [17, 48]}, BELOW = {tops: [26, 26], names: [12, 12]};  // px: the top of one curve and of several, and the middle of the line of their values; where a bar lies over the chart, or above it
const APART = 18;  // px between values
const TICKS = [7, 5];  // largest numbers of steps along and up
const ANGLES = [1, 2, 5, 10, 15, 30, 45, 90, 180, 360];  // degrees: steps along the angle of a motor
const EPS = 1e-12;
const FLAT = 1e-9;  // relative to the values: a curve that varies less has no extremes

const unitsOf = curves => [...new Set(curves.map(({unit}) => unit))];

/** The room (px) to the right of curves: a border, and an axis for each unit but the first. */
function roomOf(curves, width) {
  const more = Math.min(unitsOf(curves).length, MOST_AXES) - 1, fits = Math.floor((width - LEFT - RIGHT - LEAST_WIDE) / AXIS);
  return RIGHT + AXIS * Math.max(0, Math.min(more, fits));
}

/** The value along the axis [low, high] at x (px) in a chart of curves of a width. */
export const valueAt = (x, width, [low, high], curves) => low + (high - low) * clamp((x - LEFT) / Math.max(width - LEFT - roomOf(curves, width), 1), 0, 1);

/** The smallest and the largest of the finite values of curves, at least apart by rounding; null if there are none. */
export function rangeOf(curves) {
  let low = Infinity, high = -Infinity;
  for (const values of curves) for (const y of values) if (Number.isFinite(y)) { low = Math.min(low, y); high = Math.max(high, y); }
  if (!(high >= low)) return null;
  const least = EPS * Math.max(Math.abs(low), Math.abs(high)) || 1;
  return high - low < least ? [low - least / 2, high + least / 2] : [low, high];
}

/** Round values between two others, at most `most` steps apart; angles at parts of a turn. */
export function ticks([low, high], most, isAngle = false) {
  const least = (high - low) / most, step = isAngle ? ANGLES.find(angle => angle >= least) ?? 360 * Math.ceil(least / 360) : nice(least), first = Math.ceil(low / step - EPS) + 0, found = [];
  for (let k = first; k * step <= high + EPS * step; k++) found.push(k * step);
  return found;
}

/** The indices of the smallest and the largest value before `count`; none of a curve that is constant but for rounding. */
export function extremesOf(values, count) {
  let low = -1, high = -1;
  for (let i = 0; i < Math.min(values.length, count); i++) {
    if (!Number.isFinite(values[i])) continue;
    if (low < 0 || values[i] < values[low]) low = i;
    if (high < 0 || values[i] > values[high]) high = i;
  }
  return low < 0 || values[high] - values[low] <= FLAT * Math.max(Math.abs(values[low]), Math.abs(values[high])) ? [] : [low, high];
}

/** The values of curves {name, unit, now} in words, with their names if there are several, which are shortened to a room (px). */
export function legendOf(curves, room, wide) {
  const values = curves.map(({unit, now}) => `${Number.isFinite(now) ? short(now) : "–"}${unit && ` ${unit}`}`);
  if (curves.length === 1) return values;
  const all = curves.map(({name}, k) => `${name} ${values[k]}`), share = room / curves.length - APART;
  if (all.reduce((sum, words) => sum + wide(words) + APART, 0) <= room) return all;
  return curves.map(({name}, k) => {
    let size = name.length;
    const words = () => (size === name.length ? all[k] : size ? `${name.slice(0, size)}… ${values[k]}` : values[k]);
    while (size && wide(words()) > share) size--;
    return words();
  });
}

/** Draw curves {name, unit, values, now} over `along` {values, range, unit, now, count}: an axis for each unit; `isCovered` by a bar at its top. */
export function drawChart(context, width, height, curves, along, theme, log = false, isCovered = true) {
  const painter = new Painter(context, {x: 0, y: 0, scale: 1}, theme, 1, null), scaled = y => (log ? Math.log10(Math.max(Math.abs(y), 1e-300)) : y);
  const units = unitsOf(curves), room = roomOf(curves, width), right = width - room, bottom = height - BOTTOM, several = curves.length > 1 ? 1 : 0, {tops, names} = isCovered ? OVER : BELOW, top = tops[several];
  const ranges = new Map(units.map(unit => [unit, rangeOf(curves.filter(c => c.unit === unit).map(({values}) => Array.from(values.slice(0, along.count), scaled)))]));
  if (!ranges.get(units[0])) return painter.text("no values for this motion", [width / 2, height / 2], theme.soft, {align: "center", halo: false});
  const x = value => LEFT + Math.max(right - LEFT, 1) * (value - along.range[0]) / (along.range[1] - along.range[0] || 1);
  const up = (value, [low, high]) => bottom - (bottom - top) * (value - low) / (high - low), y = (value, range) => up(scaled(value), range), small = {size: 11, halo: false};
  const colourOf = k => theme.bodies[k % theme.bodies.length];
  const axes = units.slice(0, 1 + Math.round((room - RIGHT) / AXIS));
  axes.forEach((unit, k) => {
    const range = ranges.get(unit), at = right + AXIS * (k - 1) + 6, colour = axes.length > 1 ? readable(colourOf(curves.findIndex(c => c.unit === unit)), theme) : theme.soft;
    if (!range) return;
    const all = ticks(range, log ? 3 : TICKS[1]);
    for (const tick of all) {
      const high = up(tick, range);
      if (!k) painter.line([[LEFT, high], [right, high]], 1, theme.line); else painter.line([[at - 6, high], [at - 2, high]], 1, colour);
      painter.text(log ? `1e${Math.round(tick)}` : short(+tick.toPrecision(9)), [k ? at : LEFT - 6, high], colour, {...small, align: k ? "left" : "right"});
    }
    if (k) painter.line([[at - 6, top], [at - 6, bottom]], 1, colour);
  });
  const steps = ticks(along.range, TICKS[0], along.unit === "°");
  for (const tick of steps) {
    painter.line([[x(tick), bottom], [x(tick), bottom + 4]], 1, theme.soft);
    painter.text(`${short(+tick.toPrecision(9))}${tick === steps.at(-1) ? ` ${along.unit}` : ""}`, [Math.min(x(tick), right - 14), bottom + 12], theme.soft, {...small, align: "center"});
  }
  context.save();
  context.beginPath();
  context.rect(LEFT, 0, right - LEFT, height);
  context.clip();
  curves.forEach(({values, unit}, k) => {
    const range = ranges.get(unit);
    if (!range) return;
    context.beginPath();
    let pen = false;
    for (let i = 0; i < Math.min(values.length, along.count); i++) {
      if (!Number.isFinite(values[i])) { pen = false; continue; }
      if (pen) context.lineTo(x(along.values[i]), y(values[i], range)); else context.moveTo(x(along.values[i]), y(values[i], range));
      pen = true;
    }
    context.lineWidth = 1.7;
    context.lineJoin = "round";
    context.strokeStyle = colourOf(k);
    context.stroke();
  });
  context.restore();
  const {values, unit} = curves.at(-1), range = ranges.get(unit);
  if (range && !log) {
    extremesOf(values, along.count).forEach((i, k) => {
      const place = [x(along.values[i]), y(values[i], range)], words = `${k ? "max" : "min"} ${short(values[i])} at ${short(along.values[i])} ${along.unit}`;
      painter.circle(place, 2.4, {fill: theme.panel, stroke: colourOf(curves.length - 1)});
      context.font = "400 10.5px system-ui";
      const half = context.measureText(words).width / 2;
      painter.text(words, [clamp(place[0], LEFT + half, right - half), place[1] + (k ? 11 : -11)], theme.soft, {align: "center", size: 10.5, back: theme.panel});
    });
  }
  painter.line([[x(along.now), top - 4], [x(along.now), bottom]], 1.2, theme.ink);
  context.font = "600 12px system-ui";
  const wide = words => context.measureText(words).width, legend = legendOf(curves, width - 2 * RIGHT, wide);
  let edge = width - RIGHT;
  [...curves.entries()].reverse().forEach(([k, {unit, now}]) => {
    painter.text(legend[k], [edge, names[several]], readable(colourOf(k), theme), {align: "right", weight: 600, halo: false});
    if (Number.isFinite(now) && ranges.get(unit)) painter.circle([x(along.now), y(now, ranges.get(unit))], 3.4, {fill: colourOf(k), stroke: theme.panel});
    edge -= wide(legend[k]) + APART;
  });
  return undefined;
}
