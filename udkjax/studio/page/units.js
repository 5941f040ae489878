// Lengths and angles of a drawing in metres and radians, and back in the units of the file.

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
