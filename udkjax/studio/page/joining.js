// Joining links at pins: where bars cross, at their middles, and pins that lie on a link without belonging to it.

import {addPin, list, pinsOf, placeOf, project, settle, withKey} from "./document.js";
import {linkShape} from "./shapes.js";
import {length} from "./units.js";

const APART = 1e-9;  // fraction of a bar's length: a place closer to its end is the end
const PARALLEL = 1e-6;  // sine of the angle below which two bars do not cross

/** The ends of a bar, or null for another link. */
function endsOf(document, index) {
  const link = list(document, "link")[index], shape = linkShape(document, link);
  return shape?.kind === "line" && link.pins.length > 1 ? [shape.points[0], shape.points.at(-1)] : null;
}

/** The distance of a place from a segment. */
function away(place, [a, b]) {
  const foot = project(place, a, b), size = Math.hypot(b[0] - a[0], b[1] - a[1]), from = p => Math.hypot(foot[0] - p[0], foot[1] - p[1]);
  const beyond = Math.max(0, from(a) - size, from(b) - size);
  return Math.hypot(place[0] - foot[0], place[1] - foot[1], beyond);
}

/** The bars within `reach` (m) of a place, by their indices. */
function barsNear(document, place, reach) {
  return list(document, "link").map((_, k) => k).filter(k => { const ends = endsOf(document, k); return ends && away(place, ends) <= reach; });
}

/** The place where two bars cross; null if they do not. */
function crossing([a, b], [c, d]) {
  const u = [b[0] - a[0], b[1] - a[1]], w = [d[0] - c[0], d[1] - c[1]], cross = u[0] * w[1] - u[1] * w[0];
  if (Math.abs(cross) <= PARALLEL * Math.hypot(...u) * Math.hypot(...w)) return null;
  const s = ((c[0] - a[0]) * w[1] - (c[1] - a[1]) * w[0]) / cross, r = ((c[0] - a[0]) * u[1] - (c[1] - a[1]) * u[0]) / cross;
  return [s, r].every(x => x > -APART && x < 1 + APART) ? [a[0] + s * u[0], a[1] + s * u[1]] : null;
}

/** The middle of a bar, or its crossing with another one, if it is within `reach` (m) of a place; else null. */
export function snapOnLink(document, index, place, reach) {
  const ends = endsOf(document, index);
  if (!ends) return null;
  const places = list(document, "link").map((_, k) => (k === index ? null : endsOf(document, k))).map(other => other && crossing(ends, other));
  const near = p => (p ? Math.hypot(p[0] - place[0], p[1] - place[1]) : Infinity);
  const best = [...places, [0, 1].map(k => (ends[0][k] + ends[1][k]) / 2)].reduce((a, b) => (near(b) < near(a) ? b : a));
  return near(best) <= reach ? best : null;
}

/** The document with a pin on a link: between the ends of a bar, between the corners of a plate. */
export function joinPin(document, pin, index) {
  const link = list(document, "link")[index], shape = linkShape(document, link), pins = [...link.pins], place = placeOf(document, pin);
  let at = pins.length;
  if (shape?.kind === "line" && pins.length > 1) {
    if (link.inertia === undefined) at = pins.length - 1;  // a bar ends at its last pin
  } else if (shape?.kind === "plate" && link.inertia === undefined && !link.outline) {
    const places = pins.map(name => placeOf(document, name));
    const least = places.map((a, k) => away(place, [a, places[(k + 1) % places.length]]));
    at = least.indexOf(Math.min(...least)) + 1;
  }
  pins.splice(at, 0, pin);
  return settle(withKey(document, "link", index, "pins", pins));
}

/** The document with one more pin on a link: on the line of a bar, or between the corners of a plate. */
export function addPinToLink(document, index, place) {
  const ends = endsOf(document, index), [found, name] = addPin(document, ends ? project(place, ...ends) : place);
  return [joinPin(found, name, index), name];
}

/** A pin where bars cross, on one link, or, at a pin that lies on other links, the same pin on these. */
export function drawPin(document, {pin, link, place}, {reach}) {
  const near = barsNear(document, place, reach).filter(k => !list(document, "link")[k].pins.includes(pin));
  let found = document, name = pin;
  if (pin === null || pin === undefined) {
    const ends = near.map(k => endsOf(document, k)), at = ends.length > 1 ? crossing(ends[0], ends[1]) : null;
    if (!near.length && (link === null || link === undefined)) return {problem: "click where two bars cross, a link, or a pin that lies on a link"};
    [found, name] = addPin(found, at ?? (ends.length ? project(place, ...ends[0]) : place));
    if (!near.length) near.push(link);
  } else if (!near.length) return {problem: `${pin} lies on no link but its own`};
  for (const index of near) found = joinPin(found, name, index);
  return {document: found, select: [{kind: "pin", name}]};
}

/** The pins that look as if they were on a bar, within its width, but do not belong to it: {pin, link (its index)}. */
export function loosePins(document) {
  const found = [], slots = list(document, "slot");
  list(document, "link").forEach((link, index) => {
    const ends = endsOf(document, index);
    if (!ends || link.width === undefined) return;
    const reach = length(link.width, document) / 2, clear = p => ends.every(end => Math.hypot(p[0] - end[0], p[1] - end[1]) > reach);
    for (const pin of Object.keys(pinsOf(document))) {
      const place = placeOf(document, pin), isGuided = slots.some(slot => slot.pin === pin && (slot.on === link.name || slot.link === link.name));
      if (!place || link.pins.includes(pin) || isGuided) continue;
      if (away(place, ends) <= reach && clear(place)) found.push({pin, link: index});
    }
  });
  return found;
}
