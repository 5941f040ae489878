// Lengths and angles of a drawing in metres and radians, and back in the units of the file.

import {evaluate, namesIn} from "./expressions.js";
import {ANGLES, LENGTHS} from "./unit_sizes.js";
import {readValue} from "./values.js";

const TEXT = /^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\S.*?)?\s*$/;
const DIGITS = 12;  // significant digits of a written number; further ones are rounding

/** The sizes of the units of length and angle of numbers without a unit. */
export const lengthUnit = document => LENGTHS[document?.units?.length ?? "m"] ?? 1;
export const angleUnit = document => ANGLES[document?.units?.angle ?? "rad"] ?? 1;
export const lengthName = document => document.units?.length ?? "m";
export const angleName = document => ({deg: "°"}[document.units?.angle] ?? ` ${document.units?.angle ?? "rad"}`);

function read(value, plain, units, document) {
  if (typeof value === "number") return value * plain;
  if (typeof value !== "string") return NaN;
  const found = TEXT.exec(value), isPlain = found && (found[2] === undefined || Object.hasOwn(units, found[2]));
  if (isPlain && !usesNumbers(value, document)) return found[2] === undefined ? +found[1] * plain : +found[1] * units[found[2]];
  return evaluate(value, {angleUnit: angleUnit(document), numbers: numbersOf(document)}) * plain;
}

const named = new WeakMap();  // the named numbers of each document

/** The named numbers of a document, in its units, by name; those that cannot be computed are left out. */
export function numbersOf(document) {
  if (named.has(document)) return named.get(document);
  const found = {}, waiting = new Map(Object.entries(document?.numbers ?? {})), sizes = [[LENGTHS, lengthUnit(document)], [ANGLES, angleUnit(document)]];
  for (let count = -1; count !== waiting.size;) {
    count = waiting.size;
    for (const [name, value] of [...waiting]) {
      const [, size, unit] = (typeof value === "string" && TEXT.exec(value)) || [], known = sizes.find(([units]) => Object.hasOwn(units, unit ?? ""));
      const number = typeof value === "number" ? value : typeof value !== "string" ? NaN : known ? +size * known[0][unit] / known[1] : evaluate(value, {angleUnit: angleUnit(document), numbers: found});
      if (Number.isFinite(number)) { found[name] = number; waiting.delete(name); }
    }
  }
  named.set(document, found);
  return found;
}

/** True for a text with named numbers of a document alone: "2*r". */
export function usesNumbers(text, document) {
  const names = typeof text === "string" && document?.numbers ? namesIn(text) : [];
  return names.length > 0 && names.every(name => Object.hasOwn(document.numbers, name));
}

/** A length in metres, from a number, a string such as "12 mm" or an expression of named numbers; NaN if it is neither. */
export const length = (value, document) => read(value, lengthUnit(document), LENGTHS, document);

/** An angle in radians, from a number, a string such as "30 deg" or an expression; NaN if it is neither. */
export const angle = (value, document) => read(value, angleUnit(document), ANGLES, document);

/** The number of an expression such as 40 + 50*cos(60), in the document's unit of a quantity; undefined if the text is none. */
export function expressed(text, quantity, document) {
  const [unit, units] = {length: [lengthUnit(document), LENGTHS], angle: [angleUnit(document), ANGLES]}[quantity] ?? [1, {}];
  const value = evaluate(text, {unit, units, angleUnit: angleUnit(document), numbers: numbersOf(document)});
  return Number.isFinite(value) ? tidy(value) : undefined;
}

const NUMBERS = ["density", "length", "mass", "inertia", "angle", "count", "stiffness", "damping", "speed", "torque", "direction", ""];  // that expressions may give

/** The value of a typed text: a number of an expression, where numbers are wanted; expressions of named numbers stay texts. */
export function readMeasure(text, quantity, document) {
  const value = readValue(text, ["name", "names"].includes(quantity));
  if (usesNumbers(value, document)) return value;
  const number = typeof value === "string" && NUMBERS.includes(quantity) && !isMeasure(value) ? expressed(value, quantity === "direction" ? "angle" : quantity, document) : undefined;
  return number ?? value;
}

/** The place (m) that a text names: "x, y", or "length @ angle" from a place; null if it is neither. */
export function placeFrom(text, from, document) {
  const parts = text.includes("@") ? text.split("@") : splitPair(text);
  if (parts.length !== 2) return null;
  const isPolar = text.includes("@"), a = expressed(parts[0], "length", document), b = expressed(parts[1], isPolar ? "angle" : "length", document);
  if (a === undefined || b === undefined) return null;
  const size = a * lengthUnit(document), turn = b * angleUnit(document);
  return isPolar ? [from[0] + size * Math.cos(turn), from[1] + size * Math.sin(turn)] : [size, b * lengthUnit(document)];
}

/** The two parts of a text at a comma outside of parentheses, or at the space between two plain numbers. */
function splitPair(text) {
  let deep = 0;
  for (const [k, c] of [...text].entries()) {
    deep += c === "(" ? 1 : c === ")" ? -1 : 0;
    if (c === "," && deep === 0) return [text.slice(0, k), text.slice(k + 1)];
  }
  return text.trim().split(/\s+/);
}

/** A place in metres, or null if it is not a pair of lengths. */
export function point(value, document) {
  if (!Array.isArray(value) || value.length !== 2) return null;
  const found = value.map(x => length(x, document));
  return found.every(Number.isFinite) ? found : null;
}

/** A direction in radians, from an angle or a vector. */
export function direction(value, document) {
  if (Array.isArray(value)) return value.length === 2 ? Math.atan2(+value[1], +value[0]) : NaN;
  return angle(value, document);
}

/** True for a number with a unit or without one. */
export const isMeasure = text => TEXT.test(text) && !/[-+*/^@(]/.test(text.replace(TEXT, "$2"));

/** The unit vector of an angle (rad), exactly along an axis but for rounding. */
export const unitVector = turn => [Math.cos(turn), Math.sin(turn)].map(x => (Math.abs(x) < 1e-15 ? 0 : x));

export const tidy = x => +(+x).toPrecision(DIGITS) + 0;

/** Metres as a number in the file's unit, or, if the old value was a string with a unit, as a string in that unit. */
export function written(metres, document, old) {
  const found = typeof old === "string" ? TEXT.exec(old) : null;
  const unit = found?.[2] && LENGTHS[found[2]];
  return unit ? `${tidy(metres / unit)} ${found[2]}` : tidy(metres / lengthUnit(document));
}

/** Radians as a number in the file's unit, or, if the old value was a text with a unit, as a text in that unit. */
export function angleWritten(radians, document, old) {
  const found = typeof old === "string" ? TEXT.exec(old) : null, unit = found?.[2] && ANGLES[found[2]];
  return unit ? `${tidy(radians / unit)} ${found[2]}` : tidy(radians / angleUnit(document));
}

/** A number and its unit, to be shown. */
export function shown(value, unit) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  const text = size !== 0 && (size >= 1e5 || size < 1e-3) ? value.toExponential(2) : String(+value.toPrecision(4));
  return text.replace("-", "−") + (unit ? ` ${unit}` : "");
}

/** The largest 1, 2 or 5 times a power of ten that is at most x. */
export function niceBelow(x) {
  const power = 10 ** Math.floor(Math.log10(x) + 1e-12);
  return [5, 2, 1].map(k => k * power).find(k => k <= x * (1 + 1e-9));
}
