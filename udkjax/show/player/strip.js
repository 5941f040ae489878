// The strip below the scene: curves of a measure over time.

import {clamp, short} from "./motion.js";
import {Painter, readable} from "./painter.js";

const LEFT = 12, RIGHT = 68;  // px at the sides of the curves; the smallest and the largest value are at the right

/** The position on the timeline, from 0 to 1, of x (px) in a strip with a width. */
export const stripPart = (x, width) => clamp((x - LEFT) / (width - LEFT - RIGHT), 0, 1);

/** Draw one measure of all runs over the timeline, and a line at the time shown. */
export function drawStrip(context, width, height, runs, name, start, end, t, theme, taken) {
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
  // Values at this time, from the right: one per run, in its colour, with the run's name if there is room.
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
