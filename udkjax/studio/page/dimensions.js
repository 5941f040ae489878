// Lengths and angles that are typed for bars. Those of other bars, and the lines of slides, are dimensions, too: they are kept, or it
// is said which one gives way.

import {groundOf, list, movePin, nameOf, pinsOf, placeOf, settle} from "./document.js";
import {referencesOf} from "./pin_forms.js";
import {angle, direction, length, lengthName, lengthUnit, readMeasure, usesNumbers, written} from "./units.js";

const SAME = 1e-9;  // relative to a dimension: less is rounding of the numbers that are written
const cross = (a, b) => a[0] * b[1] - a[1] * b[0], dot = (a, b) => a[0] * b[0] + a[1] * b[1], minus = (a, b) => [a[0] - b[0], a[1] - b[1]];
const distance = (document, a, b) => Math.hypot(...minus(placeOf(document, b), placeOf(document, a)));
const bars = document => list(document, "link").filter(link => link.pins?.length === 2 && link.pins.every(pin => placeOf(document, pin)));
const numberOf = (metres, document) => `${+(metres / lengthUnit(document)).toPrecision(6)} ${lengthName(document)}`;

/** The line on which a slide holds a pin that is alone on its link: a direction, and the slide's name; null if there is none. */
function railOf(document, pin) {
  const alone = list(document, "link").filter(link => link.pins?.length === 1 && link.pins[0] === pin).map(link => link.name);
  const slides = list(document, "slide"), k = slides.findIndex(slide => alone.includes(slide.link) && !slide.on && slide.direction !== undefined);
  const way = k < 0 ? NaN : direction(slides[k].direction, document);
  return Number.isFinite(way) ? {axis: [Math.cos(way), Math.sin(way)], name: nameOf(document, "slide", k)} : null;
}

/** The dimensions of a drawing: words, value (m), and a function of their value in a drawing with the same elements. */
function dimensionsOf(document, except) {
  const lengths = bars(document).filter(link => link.name !== except.name).map(({name, pins}) => [name, found => distance(found, ...pins)]);
  const rails = Object.keys(pinsOf(document)).map(pin => [pin, railOf(document, pin)]).filter(([, rail]) => rail)
    .map(([pin, {axis, name}]) => [`the offset of ${name}`, found => cross(axis, placeOf(found, pin)), true]);
  return [...lengths, ...rails].map(([words, measure, isOffset = false]) => ({words, measure, isOffset, value: measure(document)}));
}

/** True if the place of a pin follows from another one. */
function follows(document, name, from, seen = new Set()) {
  return name === from || (!seen.has(name) && referencesOf(pinsOf(document)[name]).some(other => follows(document, other, from, seen.add(name))));
}

const withPin = (document, name, value) => ({...document, pins: {...pinsOf(document), [name]: value}});

/** Where the length of a bar is written as a number: its pin, the keys that lead to the number, and its value; null if nowhere. */
export function lengthOf(document, link) {
  for (const [pin, anchor] of [[link.pins[1], link.pins[0]], link.pins]) {
    const value = pinsOf(document)[pin];
    if (!value || Array.isArray(value) || value.to !== undefined || value.length === undefined) continue;
    const k = Array.isArray(value.from) ? value.from.indexOf(anchor) : -1;
    if (k >= 0) return {pin, keys: ["length", k], value: value.length[k]};
    if (value.from === anchor) return {pin, keys: ["length"], value: value.length};
  }
  return null;
}

/** The document in which the length of a bar, which is written as a number, is an expression of named numbers. */
export function withLengthText(document, link, text) {
  const {pin, keys: [key, k]} = lengthOf(document, link), value = pinsOf(document)[pin];
  return withPin(document, pin, {...value, [key]: k === undefined ? text : value[key].with(k, text)});
}

/** The drawings in which a pin is at a distance from its anchor, by the numbers of its form, so that its other dimensions stay. */
function placed(document, link, pin, anchor, size) {
  const value = pinsOf(document)[pin], at = placeOf(document, pin), from = placeOf(document, anchor), rail = railOf(document, pin);
  if (value && !Array.isArray(value)) {
    const k = Array.isArray(value.from) ? value.from.indexOf(anchor) : -1;
    if (k >= 0) return [withPin(document, pin, {...value, length: value.length.with(k, written(size, document, value.length[k]))})];
    const isAlone = value.from === anchor && value.length !== undefined && value.to === undefined;
    return isAlone ? [withPin(document, pin, {...value, length: written(size, document, value.length)})] : [];
  }
  if (rail) {  // where the circle meets the line, on the side of its present place
    const arm = minus(at, from), height = cross(rail.axis, arm), along = dot(rail.axis, arm), square = size * size - height * height;
    const step = (along < 0 ? -1 : 1) * Math.sqrt(Math.max(square, 0)) - along;
    return square < 0 ? [] : [movePin(document, pin, [at[0] + step * rail.axis[0], at[1] + step * rail.axis[1]])];
  }
  const others = bars(document).filter(other => other.name !== link.name && other.pins.includes(pin)).map(({pins}) => pins.find(name => name !== pin));
  if (others.length !== 1 || others[0] === anchor || [anchor, others[0]].some(name => follows(document, name, pin))) return [];
  const pair = [anchor, others[0]], side = cross(minus(placeOf(document, pair[1]), from), minus(at, from)) < 0 ? "right" : "left";
  return [withPin(document, pin, {from: pair, length: [size, distance(document, pair[1], pin)].map(x => written(x, document)), side})];
}

/** Why a length is not possible: the other bar at the pin, and the lengths between which the circles meet. */
function reason(document, link, pin, anchor, size) {
  const rail = railOf(document, pin), from = placeOf(document, anchor), name = link.name ?? "it", wanted = `${name} cannot be ${numberOf(size, document)} long`;
  if (rail) return `${wanted}: it needs at least ${numberOf(Math.abs(cross(rail.axis, minus(placeOf(document, pin), from))), document)} to the line of ${rail.name}`;
  const other = bars(document).find(one => one.name !== link.name && one.pins.includes(pin)), end = other?.pins.find(one => one !== pin);
  if (!other || end === anchor) return "";
  const r = distance(document, end, pin), d = distance(document, anchor, end);
  return `${wanted}: ${other.name} is ${numberOf(r, document)}, and ${anchor} and ${end} are ${numberOf(d, document)} apart; it needs between ${numberOf(Math.abs(d - r), document)} and ${numberOf(d + r, document)}`;
}

/**
 * The drawing with a bar of another length (m) and angle (rad), with `note`, which dimension has given way, or the `problem`.
 * Of the two pins, the one moves that changes no other dimension, if it is not `held`; a pin that closes a loop becomes given by two lengths.
 */
export function withBar(document, link, size, way, held = null) {
  const fixed = [...groundOf(document), held], dimensions = dimensionsOf(document, link), turns = Math.abs(way - wayOf(document, link)) > SAME;
  const movers = [1, 0].filter(k => !fixed.includes(link.pins[k])), found = [];
  for (const k of movers.length ? movers : [1]) {
    const [pin, anchor] = [link.pins[k], link.pins[1 - k]], from = placeOf(document, anchor), sign = k ? 1 : -1;
    if (!turns) found.push(...placed(document, link, pin, anchor, size).map(settle));
    const moved = movePin(document, pin, [from[0] + sign * size * Math.cos(way), from[1] + sign * size * Math.sin(way)]);
    if (moved !== document) found.push(settle(moved));
  }
  const possible = found.filter(one => Object.keys(pinsOf(document)).every(pin => !placeOf(document, pin) || placeOf(one, pin)) && Math.abs(distance(one, ...link.pins) - size) <= 1e-6 * size);
  const rated = possible.map(one => [one, dimensions.filter(({measure, value}) => Math.abs(measure(one) - value) > SAME * Math.max(size, Math.abs(value)))]);
  const mover = movers[0] ?? 1, why = turns ? "" : reason(document, link, link.pins[mover], link.pins[1 - mover], size);
  const best = rated.reduce((a, b) => (a && a[1].length <= b[1].length ? a : b), null);
  if (!best || (best[1].length && why && isHeld(document, link.pins[mover]))) return {problem: why || "other pins that are given by lengths would have no place"};
  const note = best[1].map(({words, measure, isOffset}) => `${words} is now ${numberOf(isOffset ? Math.abs(measure(best[0])) : measure(best[0]), document)}`).join("; ");
  return {document: best[0], note};
}

const EXAMPLES = {length: "a length above 0: write 12 or 12 mm", angle: "an angle: write 30 or 30 deg"};

/** As `withBar`, for a length or an angle as it was typed: a number, with or without a unit, or an expression of named numbers. */
export function withTypedBar(document, link, text, quantity) {
  const read = readMeasure(text, quantity, document), next = {length, angle}[quantity](read, document), isLength = quantity === "length";
  if (!Number.isFinite(next) || (isLength && !(next > 0))) return {problem: `"${text}" is not ${EXAMPLES[quantity]}`};
  const found = withBar(document, link, isLength ? next : distance(document, ...link.pins), isLength ? wayOf(document, link) : next);
  const isNamed = isLength && usesNumbers(read, document) && found.document && lengthOf(found.document, link);
  return isNamed ? {...found, document: withLengthText(found.document, link, read)} : found;
}

/** A drawing in which a pin has moved, with the lengths of bars of before, and `note`, which of them had to give way. */
function withLengths(changed, before, pin) {
  const size = link => distance(before, ...link.pins), isOther = (document, link) => Math.abs(distance(document, ...link.pins) - size(link)) > SAME * size(link);
  let found = changed;
  for (const link of bars(before).filter(one => isOther(changed, one))) {
    const next = withBar(found, link, size(link), wayOf(found, link), pin);
    if (!next.problem) found = next.document;
  }
  const note = bars(before).filter(one => isOther(found, one)).map(one => `${one.name} is now ${numberOf(distance(found, ...one.pins), found)}`).join("; ");
  return {document: found, note};
}

/** The drawing in which one number of a pin, at `keys` of its value, is the typed one. */
export function withPinNumber(document, name, [key, k], text, quantity) {
  const read = readMeasure(text, quantity, document), next = {length, angle}[quantity](read, document), value = pinsOf(document)[name];
  if (!Number.isFinite(next)) return {problem: `"${text}" is not ${EXAMPLES[quantity]}`};
  const changed = k === undefined ? read : value[key].with(k, read), found = settle(withPin(document, name, Array.isArray(value) ? value.with(key, read) : {...value, [key]: changed}));
  const lost = Object.keys(pinsOf(document)).find(pin => placeOf(document, pin) && !placeOf(found, pin));
  return lost ? {problem: `${lost} would have no place: the lengths by which it is given would not meet`} : withLengths(found, document, name);
}

/** The distance `offset` (m), along its `normal`, of the line on which a slide holds a pin from a place, and `size`, that of the pin. */
export function offsetOf(document, pin, origin) {
  const rail = railOf(document, pin), at = placeOf(document, pin);
  if (!rail || !at) return null;
  return {name: rail.name, normal: [-rail.axis[1], rail.axis[0]], offset: cross(rail.axis, minus(at, origin)), size: Math.hypot(...minus(at, origin))};
}

/** The drawing in which the line of a pin's slide is at another offset; bars at the pin keep their lengths. */
export function withLine(document, pin, origin, offset) {
  const found = offsetOf(document, pin, origin), at = placeOf(document, pin), move = offset - found.offset;
  const moved = movePin(document, pin, [at[0] + move * found.normal[0], at[1] + move * found.normal[1]]);
  return withLengths(moved, document, null);
}

const wayOf = (document, {pins: [a, b]}) => { const [x, y] = minus(placeOf(document, b), placeOf(document, a)); return Math.atan2(y, x); };

/** True if dimensions hold the pin that moves: two lengths, or a bar and the line of a slide. */
function isHeld(document, pin) {
  const value = pinsOf(document)[pin];
  return Boolean(railOf(document, pin)) || (value && !Array.isArray(value) && Array.isArray(value.from));
}
