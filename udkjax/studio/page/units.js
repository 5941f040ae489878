// Lengths and angles of a drawing in metres and radians, and back in the units of the file.

import {evaluate} from "./expressions.js";
import {ANGLES, LENGTHS} from "./unit_sizes.js";

const TEXT = /^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\S.*?)?\s*$/;
const DIGITS = 12;  // significant digits of a written number; further ones are rounding

/** The sizes of the units of length and angle of numbers without a unit. */
export const lengthUnit = document => LENGTHS[document.units?.length ?? "m"] ?? 1;
export const angleUnit = document => ANGLES[document.units?.angle ?? "rad"] ?? 1;
export const lengthName = document => document.units?.length ?? "m";

function read(value, plain, units) {
  if (typeof value === "number") return value * plain;
  const found = typeof value === "string" ? TEXT.exec(value) : null;
  if (!found) return NaN;
  return found[2] === undefined ? +found[1] * plain : +found[1] * (units[found[2]] ?? NaN);
}

/** A length in metres, from a number or a string such as "12 mm"; NaN if it is neither. */
export const length = (value, document) => read(value, lengthUnit(document), LENGTHS);

/** An angle in radians, from a number or a string such as "30 deg"; NaN if it is neither. */
export const angle = (value, document) => read(value, angleUnit(document), ANGLES);

/** The number of an expression such as 40 + 50*cos(60), in the document's unit of a quantity; undefined if the text is none. */
export function expressed(text, quantity, document) {
  const [unit, units] = {length: [lengthUnit(document), LENGTHS], angle: [angleUnit(document), ANGLES]}[quantity] ?? [1, {}];
  const value = evaluate(text, {unit, units, angleUnit: angleUnit(document)});
  return Number.isFinite(value) ? tidy(value) : undefined;
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
