// Measures of pins (udkjax/show/player/marks/pin_measures.py): the speed of an anchor, or the acute angle at the second of three.

import {place} from "./motion.js";

/** The measure at each time of a run of `size` coordinates: m/s, or degrees; empty without anchors. */
export function placedValues({ts, q, v}, size, anchors) {
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
