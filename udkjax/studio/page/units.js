// Lengths and angles of a drawing in metres and radians, and back into the units that it is written in.

const LENGTHS = {m: 1, km: 1e3, cm: 1e-2, mm: 1e-3, um: 1e-6, "µm": 1e-6, in: 0.0254, ft: 0.3048};
const ANGLES = {rad: 1, mrad: 1e-3, deg: Math.PI / 180, "°": Math.PI / 180, rev: 2 * Math.PI};
const TEXT = /^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\S.*?)?\s*$/;
const DIGITS = 12;  // of a number that is written: what lies behind them is rounding

/** The size of the unit of length, or of angle, of a document's plain numbers. */
export const lengthUnit = document => LENGTHS[document.units?.length ?? "m"] ?? 1;
export const angleUnit = document => ANGLES[document.units?.angle ?? "rad"] ?? 1;
export const lengthName = document => document.units?.length ?? "m";

function read(value, plain, units) {
  if (typeof value === "number") return value * plain;
  const found = typeof value === "string" ? TEXT.exec(value) : null;
  if (!found) return NaN;
  return found[2] === undefined ? +found[1] * plain : +found[1] * (units[found[2]] ?? NaN);
}

/** A length in metres: a plain number, or a text such as "12 mm"; not a number where it is none. */
export const length = (value, document) => read(value, lengthUnit(document), LENGTHS);

/** An angle in radians, likewise. */
export const angle = (value, document) => read(value, angleUnit(document), ANGLES);

/** A place in metres, or null where it is none. */
export function point(value, document) {
  if (!Array.isArray(value) || value.length !== 2) return null;
  const found = value.map(x => length(x, document));
  return found.every(Number.isFinite) ? found : null;
}

/** A direction (rad): an angle, or a vector. */
export function direction(value, document) {
  if (Array.isArray(value)) return value.length === 2 ? Math.atan2(+value[1], +value[0]) : NaN;
  return angle(value, document);
}

export const tidy = x => +(+x).toPrecision(DIGITS) + 0;

/** Metres as a number of the file's unit, or, where the old value was a text with a unit, as such a text. */
export function written(metres, document, old) {
  const found = typeof old === "string" ? TEXT.exec(old) : null;
  const unit = found?.[2] && LENGTHS[found[2]];
  return unit ? `${tidy(metres / unit)} ${found[2]}` : tidy(metres / lengthUnit(document));
}

/** A number and its unit, for people. */
export function shown(value, unit) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  const text = size !== 0 && (size >= 1e5 || size < 1e-3) ? value.toExponential(2) : String(+value.toPrecision(4));
  return text.replace("-", "−") + (unit ? ` ${unit}` : "");
}

/** The largest of 1, 2, 5 times a power of ten that is at most x. */
export function niceBelow(x) {
  const power = 10 ** Math.floor(Math.log10(x) + 1e-12);
  return [5, 2, 1].map(k => k * power).find(k => k <= x * (1 + 1e-9));
}
