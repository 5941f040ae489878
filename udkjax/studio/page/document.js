// Drawings as plain data (the tables of their file), and the editor's changes to them. A document is immutable: each function
// returns a new one that shares the unchanged parts.

import {inOrder, loosened, pinAt, placesOf, referencesOf, withNames} from "./pin_forms.js";
import {length, written} from "./units.js";

export const LISTS = ["link", "slide", "slot", "gear", "screw", "cam", "motor", "spring", "damper", "load", "body", "joint", "driver", "force"];
// Keys of tables that name pins and links.
const PIN_KEYS = ["pin", "pins", "along", "between"], LINK_KEYS = ["link", "on", "links", "of", "carrier", "bodies", "body"];
export const NAME_KEYS = [...PIN_KEYS, ...LINK_KEYS, "slide"];
const GROUND = "ground";
const THICKNESS = 0.005;  // m, of a link that gets a density
const OFF_LINE = 1e-9;  // fraction of a line's length: a pin closer to the line lies on it
const INNER = 0.05;  // fraction of a bar's length that its inner pins keep from its ends

export const EMPTY = {format: 2, units: {length: "mm", angle: "deg"}, ground: [], pins: {}};

export const list = (document, section) => (Array.isArray(document[section]) ? document[section] : []);
export const pinsOf = document => document.pins ?? {};
export const groundOf = document => document.ground ?? [];
export const placeOf = (document, pin) => placesOf(document)[pin] ?? null;

/** The name of an element: its own, or the section's with its number. */
export const nameOf = (document, section, index) => list(document, section)[index]?.name ?? `${section}${index + 1}`;

/** The names of pins and elements that an entry refers to. */
export const namesOf = entry => NAME_KEYS.flatMap(key => [entry[key]].flat()).filter(name => typeof name === "string");

/** The document with a section replaced; an empty section is left out. */
function withSection(document, section, entries) {
  const {[section]: _, ...rest} = document;
  const order = Object.keys(document);
  if (!entries.length) return rest;
  return order.includes(section) ? {...document, [section]: entries} : {...rest, [section]: entries};
}

/** The document with one key of an element changed, or removed if the value is undefined. */
export function withKey(document, section, index, key, value) {
  return withEntry(document, section, index, entry => {
    const {[key]: _, ...rest} = entry;
    return value === undefined ? rest : key in entry ? {...entry, [key]: value} : {...rest, [key]: value};
  });
}

/** The document with a value of an element: of a link, a mass and a density replace each other. */
export function withValue(document, section, index, key, value) {
  const found = withKey(document, section, index, key, value), entry = list(found, section)[index], other = {mass: "density", density: "mass"}[key];
  if (section !== "link" || value === undefined || !other) return found;
  const changed = withKey(found, section, index, other, undefined), lacks = key === "density" && entry.thickness === undefined;
  return lacks ? withKey(changed, section, index, "thickness", written(THICKNESS, found)) : changed;
}

export function withEntry(document, section, index, change) {
  return withSection(document, section, list(document, section).map((entry, k) => (k === index ? change(entry) : entry)));
}

/** The document with one more element. */
export const withElement = (document, section, entry) => withSection(document, section, [...list(document, section), entry]);

/** The members of a pin: the ground if it is fixed, and the names of the links that share it. */
export function members(document, pin) {
  const links = list(document, "link").filter(link => link.pins?.includes(pin)).map(link => link.name);
  return groundOf(document).includes(pin) ? [GROUND, ...links] : links;
}

/** An unused name for a pin: A, B, ..., Z, A1, ... */
function freshPin(document) {
  const taken = new Set([...Object.keys(pinsOf(document)), ...LISTS.flatMap(s => list(document, s).map((_, k) => nameOf(document, s, k)))]);
  for (let k = 0; ; k++) {
    const name = String.fromCharCode(65 + (k % 26)) + (k < 26 ? "" : Math.floor(k / 26));
    if (!taken.has(name)) return name;
  }
}

/** An unused name for an element: link1, link2, ... */
export function freshName(document, base) {
  const taken = new Set([...Object.keys(pinsOf(document)), ...LISTS.flatMap(s => list(document, s).map((_, k) => nameOf(document, s, k)))]);
  for (let k = 1; ; k++) if (!taken.has(`${base}${k}`)) return `${base}${k}`;
}

/** The document with a new pin at a place (m), and the pin's name. */
export function addPin(document, place) {
  const name = freshPin(document);
  return [movePin(document, name, place), name];
}

const withPin = (document, name, place) => ({...document, pins: {...pinsOf(document), [name]: pinAt(document, name, place)}});

/** A changed document, or the one before if a pin would lose its place: circles no longer meet. */
function withPlaces(found, before) {
  const at = placesOf(found);
  return Object.keys(placesOf(before)).every(name => at[name] || !Object.hasOwn(pinsOf(found), name)) ? found : before;
}

/** The document with a pin at another place (m), by the numbers of its form; unchanged if another pin would lose its place. */
export const movePin = (document, name, place) => withPlaces(withPin(document, name, place), document);

/** The document with some pins moved by (dx, dy) metres. */
export function shiftPins(document, names, dx, dy) {
  let found = document;
  for (const name of inOrder(document, names)) {
    const place = placeOf(document, name);
    if (place) found = withPin(found, name, [place[0] + dx, place[1] + dy]);
  }
  return withPlaces(found, document);
}

/** The document with pins moved onto their lines: inner pins of bars, and pins in slots along two pins. */
export function settle(document) {
  let found = document;
  for (const {pins = [], width, inertia, outline} of list(document, "link")) {
    if (width === undefined || inertia !== undefined || outline || pins.length < 3) continue;
    for (const pin of pins.slice(1, -1)) found = ontoLine(found, pin, [pins[0], pins.at(-1)], true);
  }
  for (const slot of list(document, "slot")) {
    if (slot.along?.length === 2) found = ontoLine(found, slot.pin, slot.along);
  }
  return found;
}

/** The document with a pin moved onto the line through two others and, if asked, between them. */
function ontoLine(document, pin, along, between = false) {
  const ends = along.map(name => placeOf(document, name)), at = placeOf(document, pin);
  if (!ends.every(Boolean) || !at) return document;
  const [dx, dy] = [ends[1][0] - ends[0][0], ends[1][1] - ends[0][1]], square = dx * dx + dy * dy;
  let foot = project(at, ...ends);
  const s = square > 0 ? ((foot[0] - ends[0][0]) * dx + (foot[1] - ends[0][1]) * dy) / square : 0;
  if (between && !(s > INNER && s < 1 - INNER)) {
    const inner = Math.min(Math.max(s, INNER), 1 - INNER);
    foot = [ends[0][0] + inner * dx, ends[0][1] + inner * dy];
  }
  const off = Math.hypot(foot[0] - at[0], foot[1] - at[1]);
  return off > OFF_LINE * Math.sqrt(square) ? movePin(document, pin, foot) : document;
}

/** The point of the line through a and b that is nearest to p. */
export function project(p, a, b) {
  const dx = b[0] - a[0], dy = b[1] - a[1], square = dx * dx + dy * dy;
  const s = square > 0 ? ((p[0] - a[0]) * dx + (p[1] - a[1]) * dy) / square : 0;
  return [a[0] + s * dx, a[1] + s * dy];
}

/** A value with its names replaced; a list loses duplicates. */
function renamed(value, names) {
  if (Array.isArray(value)) return [...new Set(value.map(x => names.get(x) ?? x))];
  return names.get(value) ?? value;
}

function renameKeys(document, keys, names) {
  let found = document;
  for (const section of LISTS) {
    const entries = list(found, section).map(entry => {
      const changed = Object.fromEntries(keys.filter(key => key in entry).map(key => [key, renamed(entry[key], names)]));
      return keys.some(key => key in entry && JSON.stringify(changed[key]) !== JSON.stringify(entry[key])) ? {...entry, ...changed} : entry;
    });
    if (entries.some((entry, k) => entry !== list(found, section)[k])) found = {...found, [section]: entries};
  }
  return found;
}

/** The document with a pin renamed; a taken or empty name changes nothing. */
export function renamePin(document, old, name) {
  if (!name || name === old || Object.hasOwn(pinsOf(document), name)) return document;
  const swap = key => (key === old ? name : key), again = table => Object.fromEntries(Object.entries(table).map(([k, v]) => [swap(k), withNames(v, swap)]));
  const found = {...document, pins: again(pinsOf(document)), ground: groundOf(document).map(swap)};
  if (document.velocities) found.velocities = again(document.velocities);
  return renameKeys(found, PIN_KEYS, new Map([[old, name]]));
}

/** The document with an element renamed, and all references to it. */
export function renameElement(document, section, index, name) {
  const old = nameOf(document, section, index), taken = list(document, section).some((_, k) => nameOf(document, section, k) === name);
  if (!name || name === old || taken) return document;
  const found = withEntry(document, section, index, entry => ({name, ...entry, ...{name}}));
  const keys = section === "link" ? LINK_KEYS : section === "slide" ? ["slide"] : [];
  return renameKeys(found, keys, new Map([[old, name]]));
}

/** The document with two pins merged: everything at `from` moves to `into`. Links left with a single pin are removed. */
export function mergePins(document, from, into) {
  if (from === into) return document;
  const {[from]: _, ...pins} = pinsOf(document);
  const swap = pin => (pin === from ? into : pin), swapped = Object.fromEntries(Object.entries(pins).map(([k, v]) => [k, withNames(v, swap)]));
  const found = loosened({...document, pins: swapped, ground: [...new Set(groundOf(document).map(swap))]}, document);
  if (document.velocities) found.velocities = Object.fromEntries(Object.entries(document.velocities).filter(([pin]) => pin !== from));
  const merged = renameKeys(found, PIN_KEYS, new Map([[from, into]]));
  const gone = list(merged, "link").flatMap((link, k) => (link.pins.length < list(document, "link")[k].pins.length && link.pins.length < 2 ? [k] : []));
  return removeElements(merged, gone.map(index => ({kind: "link", index})));
}

/** The document with a pin fixed to the ground, or freed. */
export function toggleGround(document, pin) {
  const ground = groundOf(document);
  return {...document, ground: ground.includes(pin) ? ground.filter(name => name !== pin) : [...ground, pin]};
}

/** The document without some items, {kind: "pin", name} or {kind: section, index}, and without elements that need them. */
export function removeElements(document, items) {
  const names = new Set(items.filter(item => item.kind === "pin").map(item => item.name));
  let found = document;
  if (names.size) {
    const links = list(found, "link").map(link => (link.pins?.some(p => names.has(p)) ? {...link, pins: link.pins.filter(p => !names.has(p))} : link));
    const before = list(found, "link");
    const dead = new Set(before.flatMap((link, k) => (links[k] !== link && links[k].pins.length < Math.min(2, link.pins.length) ? [k] : [])));
    items = [...items, ...[...dead].map(index => ({kind: "link", index}))];
    found = {...found, link: links};
  }
  const gone = Object.fromEntries(LISTS.map(s => [s, new Set(items.filter(item => item.kind === s).map(item => item.index))]));
  const lost = new Set([...gone.link].map(index => list(document, "link")[index]?.name));
  const slides = new Set([...gone.slide].map(index => nameOf(document, "slide", index)));
  for (const section of LISTS) {
    const refers = entry => section !== "link" && (PIN_KEYS.some(key => [entry[key]].flat().some(x => names.has(x)))
      || LINK_KEYS.some(key => [entry[key]].flat().some(x => lost.has(x))));
    list(document, section).forEach((entry, k) => { if (refers(entry)) gone[section].add(k); });
  }
  gone.slide.forEach(index => slides.add(nameOf(document, "slide", index)));
  list(document, "motor").forEach((motor, k) => { if (slides.has(motor.slide)) gone.motor.add(k); });
  for (const section of LISTS) {
    if (gone[section].size) found = withSection(found, section, list(found, section).filter((_, k) => !gone[section].has(k)));
  }
  found = dropUnsupported(document, found);
  found = loosened(dropPins(found, pin => names.has(pin)), document);
  const before = usedPins(document);
  for (;;) {  // a pin that goes may have been the last to refer to another one
    const after = usedPins(found), lost = new Set(Object.keys(pinsOf(found)).filter(pin => before.has(pin) && !after.has(pin)));
    if (!lost.size) return found;
    found = dropPins(found, pin => lost.has(pin));
  }
}

/** The document without motors, springs, dampers and loads at pins that have lost the members they acted on. */
function dropUnsupported(before, document) {
  let found = document;
  for (const section of ["motor", "spring", "damper", "load"]) {
    const least = section === "load" ? 1 : 2, met = (doc, pin) => members(doc, pin).filter(name => least === 2 || name !== GROUND).length;
    const kept = list(found, section).filter(entry => entry.pin === undefined || met(before, entry.pin) < least || met(document, entry.pin) >= least);
    if (kept.length < list(found, section).length) found = withSection(found, section, kept);
  }
  return found;
}

/** The names of pins that tables and other pins refer to. */
const usedPins = document => new Set([...Object.values(pinsOf(document)).flatMap(referencesOf),
  ...LISTS.flatMap(s => list(document, s).flatMap(entry => PIN_KEYS.flatMap(key => [entry[key]].flat())))]);

function dropPins(document, isDropped) {
  const keep = pin => !isDropped(pin), only = table => Object.fromEntries(Object.entries(table ?? {}).filter(([pin]) => keep(pin)));
  const found = {...document, pins: only(document.pins), ground: groundOf(document).filter(keep)};
  if (document.velocities) found.velocities = only(document.velocities);
  return found;
}

/** The pins of items. */
export function pinsOfItems(document, items) {
  return [...new Set(items.flatMap(item => (item.kind === "pin" ? [item.name]
    : item.kind === "link" ? list(document, "link")[item.index]?.pins ?? [] : [])))];
}

/** Points (pairs in the drawing's units) of an element, (dx, dy) metres away. */
export function shiftedPoints(value, document, dx, dy) {
  if (Array.isArray(value[0])) return value.map(p => shiftedPoints(p, document, dx, dy));
  return value.map((x, k) => written(length(x, document) + (k ? dy : dx), document, x));
}
