// Gaps between links: outlines of links that touch are painted red, and a button leads to the least gap of the motion.

import {button} from "./elements.js";
import {isNear} from "./symbols.js";

const OPACITY = 0.4;
const side = ([ax, ay], [bx, by], [x, y]) => Math.sign((bx - ax) * (y - ay) - (by - ay) * (x - ax));
const edges = points => points.map((point, k) => [point, points[(k + 1) % points.length]]);
const cross = ([a, b], [c, d]) => side(a, b, c) * side(a, b, d) < 0 && side(c, d, a) * side(c, d, b) < 0;

/** True if two convex outlines, lines or points overlap or are closer to each other than `reach`. */
export function touch(one, other, reach) {
  const holds = (outline, point) => isNear(point, outline.length > 1 ? outline : [outline[0], outline[0]], outline.length > 2, reach);
  return one.some(point => holds(other, point)) || other.some(point => holds(one, point))
    || edges(one).some(edge => edges(other).some(another => cross(edge, another)));
}

/** Paint the links that touch in the pose of a painter; `parts` and `pairs` are described in gap_records.py. Returns their parts. */
export function paintTouching(painter, {parts, pairs}) {
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
export class GapMarks {
  constructor(player) {
    const [least] = player.runs.map(run => run.gaps).filter(Boolean).sort((a, b) => a.least - b.least);
    this.show = () => { player.pause(); player.seek(least.t); };
    this.button = button("Least gap", `go to the least gap: ${least.words} (G)`, this.show);
  }
}
