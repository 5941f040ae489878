// Lengths and angles that are typed for bars. Those of other bars, and the lines of slides, are dimensions, too: they are kept, or it
// is said which one gives way.

import {groundOf, list, movePin, nameOf, pinsOf, placeOf, settle} from "./document.js";
import {fitted} from "./fitting.js";
import {axisOf, placesOf, referencesOf} from "./pin_forms.js";
import {barPins} from "./shapes.js";
import {angle, direction, length, lengthName, lengthUnit, readMeasure, unitVector, usesNumbers, written} from "./units.js";

const SAME = 1e-9;  // relative to a dimension: less is rounding of the numbers that are written
const cross = (a, b) => a[0] * b[1] - a[1] * b[0], dot = (a, b) => a[0] * b[0] + a[1] * b[1], minus = (a, b) => [a[0] - b[0], a[1] - b[1]];
const distance = (document, a, b) => Math.hypot(...minus(placeOf(document, b), placeOf(document, a)));
const far = ([a, b], at) => Math.hypot(...minus(at[b], at[a]));
/** Bars, {name, pins, of}: a bar of more than two pins, whose name is `of`, is one between each pin and the next. */
export const bars = document => list(document, "link").flatMap(link => {
  const pins = barPins(document, link);
  return pins.slice(1).map((pin, k) => ({of: link.name, name: pins.length > 2 ? `${pins[k]}-${pin} of ${link.name}` : link.name, pins: pins.length > 2 ? [pins[k], pin] : link.pins}));
});
const numberOf = (metres, document) => `${+(metres / lengthUnit(document)).toPrecision(6)} ${lengthName(document)}`;

/** The line of the ground on which a slot holds a pin, or a slide one that is alone on its link: a direction, and the name of either; null if there is none. */
function railOf(document, pin) {
  const alone = list(document, "link").filter(link => link.pins?.length === 1 && link.pins[0] === pin).map(link => link.name);
  for (const [kind, holds] of [["slide", ({link}) => alone.includes(link)], ["slot", one => one.pin === pin]]) {
    const k = list(document, kind).findIndex(one => holds(one) && !one.on && one.direction !== undefined), way = k < 0 ? NaN : direction(list(document, kind)[k].direction, document);
    if (Number.isFinite(way)) return {axis: [Math.cos(way), Math.sin(way)], name: nameOf(document, kind, k)};
  }
  return null;
}

/** The dimensions of a drawing: words, their pins, their value (m), and a function of it in places by name. */
function dimensionsOf(document, except) {
  const lengths = bars(document).filter(link => link.name !== except.name).map(({name, pins}) => ({words: name, pins, measure: at => far(pins, at)}));
  const rails = Object.keys(pinsOf(document)).map(pin => [pin, railOf(document, pin)]).filter(([, rail]) => rail)
    .map(([pin, {axis, name}]) => ({words: `the offset of ${name}`, pins: [pin], measure: at => cross(axis, at[pin]), isOffset: true}));
  return [...lengths, ...rails].map(one => ({...one, value: one.measure(placesOf(document))}));
}

/** The drawing with pins moved, except for `fixed` ones, so that further conditions, all dimensions, angles and lines hold; null if there is none near. */
function fit(document, wanted, dimensions, fixed) {
  const lines = list(document, "slot").filter(({along}) => along?.length === 2).map(({pin, along}) => [...along, pin]), now = placesOf(document);
  for (const link of list(document, "link")) {
    const chain = barPins(document, link);
    for (const pin of chain.slice(1, -1)) lines.push([chain[0], chain.at(-1), pin]);
  }
  const straight = lines.filter(pins => pins.every(pin => now[pin])).map(pins => ({pins, error: at => cross(minus(at[pins[1]], at[pins[0]]), minus(at[pins[2]], at[pins[0]])) / far(pins, at)}));
  const kept = dimensions.map(({pins, measure, value}) => ({pins, error: at => measure(at) - value}));
  return fitted(document, [...wanted, ...kept, ...angles(document), ...straight], fixed);
}

/** The conditions that a bar has a length (m) and, if it turns, an angle (rad). */
function asBar({pins, pins: [a, b]}, size, way) {
  if (way === null) return [{pins, error: at => far(pins, at) - size}];
  return [Math.cos(way), Math.sin(way)].map((part, k) => ({pins, error: at => at[b][k] - at[a][k] - size * part}));
}

/** The angles by which pins are given, as conditions. */
function angles(document) {
  const now = placesOf(document), found = [];
  for (const [pin, form] of Object.entries(pinsOf(document))) {
    const by = form?.angle === undefined || form.to !== undefined ? NaN : angle(form.angle, document);
    if (!Number.isFinite(by) || !now[pin]) continue;
    const across = at => { const axis = axisOf(form, at); return [-axis[0] * Math.sin(by) - axis[1] * Math.cos(by), axis[0] * Math.cos(by) - axis[1] * Math.sin(by)]; };
    found.push({pins: [pin, form.from, ...form.line ?? []], error: at => dot(across(at), minus(at[pin], at[form.from]))});
  }
  return found;
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
  const beside = bars(document).filter(other => other.name !== link.name && other.pins.includes(pin)), others = beside.map(({pins}) => pins.find(name => name !== pin));
  if (beside.some(({of}) => of === (link.of ?? link.name)) || others.length !== 1 || others[0] === anchor || [anchor, others[0]].some(name => follows(document, name, pin))) return [];
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
    const moved = movePin(document, pin, unitVector(way).map((x, i) => from[i] + sign * size * x));
    if (moved !== document) found.push(settle(moved));
  }
  const possible = found.filter(one => Object.keys(pinsOf(document)).every(pin => !placeOf(document, pin) || placeOf(one, pin)) && Math.abs(distance(one, ...link.pins) - size) <= 1e-6 * size);
  const rate = one => [one, dimensions.filter(({measure, value}) => Math.abs(measure(placesOf(one)) - value) > SAME * Math.max(size, Math.abs(value)))];
  const rated = possible.map(rate);
  if (rated.every(([, broken]) => broken.length)) {  // several pins have to move
    const all = fit(document, asBar(link, size, turns ? way : null), dimensions, fixed);
    if (all) rated.push(rate(settle(all)));
  }
  const mover = movers[0] ?? 1, why = turns ? "" : reason(document, link, link.pins[mover], link.pins[1 - mover], size);
  const best = rated.reduce((a, b) => (a && a[1].length <= b[1].length ? a : b), null);
  if (!best || (best[1].length && why && isHeld(document, link.pins[mover]))) return {problem: why || "other pins that are given by lengths would have no place"};
  const note = best[1].map(({words, measure, isOffset}) => `${words} is now ${numberOf(isOffset ? Math.abs(measure(placesOf(best[0]))) : measure(placesOf(best[0])), document)}`).join("; ");
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

/** A drawing in which a pin has moved, with the `dimensions` of before, and `note`, which lengths of bars had to give way. */
function withLengths(moved, before, dimensions, pin) {
  const all = fit(moved, [], dimensions, [...groundOf(before), pin]);
  if (all) return {document: settle(all), note: ""};
  const changed = settle(moved), size = link => distance(before, ...link.pins), isOther = (document, link) => Math.abs(distance(document, ...link.pins) - size(link)) > SAME * size(link);
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
  const changed = k === undefined ? read : value[key].with(k, read), found = withPin(document, name, Array.isArray(value) ? value.with(key, read) : {...value, [key]: changed});
  const lost = Object.keys(pinsOf(document)).find(pin => placeOf(document, pin) && !placeOf(found, pin));
  return lost ? {problem: `${lost} would have no place: the lengths by which it is given would not meet`} : withLengths(found, document, dimensionsOf(document, {}), name);
}

/** The distance `offset` (m), along its `normal`, of the line on which a slide or a slot holds a pin from a place, and `size`, that of the pin. */
export function offsetOf(document, pin, origin) {
  const rail = railOf(document, pin), at = placeOf(document, pin);
  if (!rail || !at) return null;
  return {name: rail.name, normal: [-rail.axis[1], rail.axis[0]], offset: cross(rail.axis, minus(at, origin)), size: Math.hypot(...minus(at, origin))};
}

/** The drawing in which the line of a pin's slide or slot is at another offset; bars at the pin keep their lengths. */
export function withLine(document, pin, origin, offset) {
  const found = offsetOf(document, pin, origin), at = placeOf(document, pin), move = offset - found.offset;
  const moved = movePin(document, pin, [at[0] + move * found.normal[0], at[1] + move * found.normal[1]]);
  const dimensions = dimensionsOf(document, {}).map(one => (one.isOffset && one.pins[0] === pin ? {...one, value: one.value + move} : one));
  return withLengths(moved, document, dimensions, null);
}

const wayOf = (document, {pins: [a, b]}) => { const [x, y] = minus(placeOf(document, b), placeOf(document, a)); return Math.atan2(y, x); };

/** True if dimensions hold the pin that moves: two lengths, or a bar and the line of a slide. */
function isHeld(document, pin) {
  const value = pinsOf(document)[pin];
  return Boolean(railOf(document, pin)) || (value && !Array.isArray(value) && Array.isArray(value.from));
}
