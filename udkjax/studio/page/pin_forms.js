// Pins by lengths and angles: where they are, and their numbers for another place. A pin is [x, y], or a table that refers to others.

import {angle, angleWritten, length, point, usesNumbers, written} from "./units.js";

const ROUNDING = 1e-9;  // relative to the lengths of a form: an offset below it is none
const places = new WeakMap();  // of the pins of each document
const isTable = value => typeof value === "object" && value !== null && !Array.isArray(value);
const minus = (a, b) => [a[0] - b[0], a[1] - b[1]], plus = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1], cross = (a, b) => a[0] * b[1] - a[1] * b[0], left = a => [-a[1], a[0]];
const unit = a => { const size = Math.hypot(...a); return size > 0 ? [a[0] / size, a[1] / size] : null; };
const turned = (a, by) => [a[0] * by[0] - a[1] * by[1], a[0] * by[1] + a[1] * by[0]];

/** The pins that a pin refers to. */
export const referencesOf = value => (isTable(value) ? [value.stacked, value.from, value.to, value.on, value.line].flat().filter(name => typeof name === "string") : []);

/** A pin that refers to other names. */
export function withNames(value, swap) {
  if (!isTable(value)) return value;
  const again = names => (Array.isArray(names) ? names.map(swap) : swap(names));
  return Object.fromEntries(Object.entries(value).map(([key, x]) => [key, ["stacked", "from", "to", "on", "line"].includes(key) ? again(x) : x]));
}

/** The places (m) of all pins that have one, by name. */
export function placesOf(document) {
  if (!places.has(document)) places.set(document, computed(document));
  return places.get(document);
}

function computed(document) {
  const found = {}, waiting = new Map(Object.entries(document.pins ?? {}));
  for (let count = -1; count !== waiting.size;) {
    count = waiting.size;
    for (const [name, value] of [...waiting]) {
      if (!referencesOf(value).every(other => Object.hasOwn(found, other))) continue;
      const place = isTable(value) ? formPlace(value, found, document) : point(value, document);
      if (place?.every(Number.isFinite)) found[name] = place;
      waiting.delete(name);
    }
  }
  return found;
}

/** The direction from which the angle of a form is counted: that of its line, or the x axis. */
export function axisOf({line, along}, at) {
  if (Array.isArray(along)) return unit(along);
  return line?.length === 2 ? unit(minus(at[line[1]], at[line[0]])) : [1, 0];
}

function formPlace(form, at, document) {
  const metres = value => length(value, document);
  if (form.stacked !== undefined) return at[form.stacked] ?? null;
  if (Array.isArray(form.from)) {
    const [start, end] = form.from.map(name => at[name]), [r, s] = (Array.isArray(form.length) ? form.length : []).map(metres);
    if (!start || !end) return null;
    const d = Math.hypot(...minus(end, start)), axis = unit(minus(end, start)), x = (d * d + r * r - s * s) / (2 * d);
    const square = (s - d + r) * (s + d - r) * (d + r - s) * (d + r + s), rounding = 1e-12 * d * r * s * (r + s);
    const y = Math.abs(square) <= rounding ? 0 : Math.sqrt(square) / (2 * d);
    return axis && plus(plus(start, axis, x), left(axis), form.side === "right" ? -y : y);
  }
  const start = at[form.from];
  if (!start) return null;
  if (form.to !== undefined) {
    const arm = at[form.to] && minus(at[form.to], start), axis = arm && unit(arm);
    if (!axis) return null;
    const foot = form.share === undefined ? plus(start, axis, metres(form.length)) : plus(start, arm, +form.share);
    return form.off === undefined ? foot : plus(foot, left(axis), metres(form.off));
  }
  if (form.on !== undefined) {
    const axis = at[form.on] && Array.isArray(form.along) && unit(form.along);
    if (!axis) return null;
    const arm = minus(start, at[form.on]), size = metres(form.length), height = cross(axis, arm), square = (size - height) * (size + height);
    const way = Math.abs(square) <= 1e-13 * size * size ? 0 : Math.sqrt(square);
    return plus(at[form.on], axis, dot(axis, arm) + (form.side === "behind" ? -way : way));
  }
  const axis = axisOf(form, at), by = Array.isArray(form.along) ? 0 : angle(form.angle, document);
  return axis && plus(start, turned(axis, [Math.cos(by), Math.sin(by)]), metres(form.length));
}

/** The value of a pin at a place (m): its coordinates, or the numbers of its form. A form on a line keeps the pin on it, and expressions of
 *  named numbers stay: the pin comes as near as the other numbers allow. */
export function pinAt(document, name, place) {
  const old = document.pins?.[name];
  return withExpressions(valueAt(document, old, place), old, document);
}

function withExpressions(value, old, document) {
  if (usesNumbers(old, document)) return old;
  if (typeof old !== "object" || old === null || typeof value !== "object") return value;
  const kept = Object.entries(value).map(([key, x]) => [key, withExpressions(x, old[key], document)]);
  return Array.isArray(value) ? kept.map(([, x]) => x) : Object.fromEntries(kept);
}

function valueAt(document, old, place) {
  const at = placesOf(document);
  if (!isTable(old)) return place.map((x, k) => written(x, document, old?.[k]));
  const metres = (x, key) => written(x, document, old[key]);
  if (old.stacked !== undefined || !referencesOf(old).every(other => at[other])) return old;
  if (Array.isArray(old.from)) {
    const [start, end] = old.from.map(other => at[other]), lengths = [start, end].map(p => Math.hypot(...minus(place, p)));
    return {...old, length: lengths.map((x, k) => written(x, document, old.length?.[k])), side: cross(minus(end, start), minus(place, start)) < 0 ? "right" : "left"};
  }
  const arm = minus(place, at[old.from]);
  if (old.to !== undefined) {
    const line = minus(at[old.to], at[old.from]), axis = unit(line);
    if (!axis) return old;
    const along = old.share === undefined ? {length: metres(dot(arm, axis), "length")} : {share: +(dot(arm, line) / dot(line, line)).toPrecision(12)};
    return {...old, ...along, ...(old.off === undefined ? {} : {off: metres(cross(axis, arm), "off")})};
  }
  if (old.on !== undefined) {
    const axis = Array.isArray(old.along) && unit(old.along), foot = axis && plus(at[old.on], axis, dot(axis, minus(place, at[old.on])));
    const way = foot && minus(foot, at[old.from]);
    return way ? {...old, length: metres(Math.hypot(...way), "length"), ...(old.side || dot(axis, way) < 0 ? {side: dot(axis, way) < 0 ? "behind" : "ahead"} : {})} : old;
  }
  const axis = axisOf(old, at), size = Math.hypot(...arm);
  if (!axis || !size) return old;
  if (Array.isArray(old.along)) return dot(arm, axis) > 0 ? {...old, length: metres(dot(arm, axis), "length")} : old;
  return {...old, length: metres(size, "length"), angle: angleWritten(Math.atan2(cross(axis, arm), dot(axis, arm)), document, old.angle)};
}

/** Forms that a pin may have in its place, by words: coordinates, or lengths from pins `near` it. Pins that follow from it are left out. */
export function formsOf(document, name, near) {
  const place = placesOf(document)[name];
  if (!place) return [];
  const follows = (other, seen = new Set()) => other === name || (!seen.has(other)
    && referencesOf(document.pins?.[other]).some(next => follows(next, seen.add(other))));
  const free = [...new Set(near)].filter(other => !follows(other) && placesOf(document)[other]);
  const as = form => pinAt({...document, pins: {...document.pins, [name]: form}}, name, place);
  const pairs = free.flatMap((a, k) => free.slice(k + 1).map(b => [a, b]));
  return [["coordinates", as(["", ""])],
    ...free.map(from => [`length and angle from ${from}`, as({from, length: 0, angle: 0})]),
    ...pairs.map(from => [`lengths from ${from.join(" and ")}`, as({from, length: [0, 0], side: "left"})]),
    ...pairs.filter(([a, b]) => distanceOf(document, a, b) > 0).map(([from, to]) => [`along the line of ${from}-${to}`, onLine(as({from, to, length: 0, off: 0}), document)])];
}

const distanceOf = (document, a, b) => Math.hypot(...minus(placesOf(document)[a], placesOf(document)[b]));

/** A form on a line without the offset from it, if that is only rounding. */
function onLine({off, ...form}, document) {
  const [a, b] = [length(off, document), length(form.length, document)];
  return Math.abs(a) <= ROUNDING * Math.max(Math.abs(b), distanceOf(document, form.from, form.to)) ? form : {...form, off};
}

/** The words of the form in which a pin is given. */
export function formWords(value) {
  if (!isTable(value)) return "coordinates";
  if (value.stacked !== undefined) return `the place of ${value.stacked}`;
  if (Array.isArray(value.from)) return `lengths from ${value.from.join(" and ")}`;
  if (value.to !== undefined) return `along the line of ${value.from}-${value.to}`;
  return value.on === undefined ? `length and angle from ${value.from}` : `length from ${value.from}, on a line through ${value.on}`;
}

/** The pins in an order in which each one stands behind those that it refers to. */
export function inOrder(document, names) {
  const depth = (name, seen = new Set()) => (seen.has(name) ? 0
    : 1 + Math.max(0, ...referencesOf(document.pins?.[name]).map(other => depth(other, new Set([...seen, name])))));
  return [...names].sort((a, b) => depth(a) - depth(b));
}

/** The document in which pins that have lost their place, as those that they refer to are gone, have the coordinates of before. */
export function loosened(document, before) {
  const had = placesOf(before);
  for (let found = document; ;) {
    const at = placesOf(found), lost = Object.keys(found.pins ?? {}).filter(name => isTable(found.pins[name]) && !at[name] && had[name]);
    if (!lost.length) return found;
    // Pins that follow from others get a place again; of a circle of references, the first is loosened.
    const name = lost.find(one => referencesOf(found.pins[one]).every(other => !lost.includes(other))) ?? lost[0];
    found = {...found, pins: {...found.pins, [name]: had[name].map(x => written(x, found))}};
  }
}
