// Expressions in fields and files: 40 + 50*cos(60), 2*12 mm, sqrt(3)/2, and places such as 50 @ 60, which is a length and an angle.

const TOKEN = /\s*(?:((?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)|([A-Za-zÀ-ɏα-ω°µ"'′″_][\wÀ-ɏα-ω°µ"'′″]*)|([-+*/^(),]))/y;
const FUNCTIONS = {sqrt: Math.sqrt, abs: Math.abs, exp: Math.exp, log: Math.log, min: Math.min, max: Math.max, hypot: Math.hypot};
const TURNING = {sin: Math.sin, cos: Math.cos, tan: Math.tan}, ANGLES_OF = {asin: Math.asin, acos: Math.acos, atan: Math.atan, atan2: Math.atan2};

/** The value of an expression; NaN if it is none.
 *
 *  `unit` is the size of numbers without a unit, and `units` the sizes of units by name; the value is in `unit`. Angles of sin, cos and
 *  tan are in `angleUnit`, in which asin, acos and atan return theirs. `numbers` are values by name.
 */
export function evaluate(given, {unit = 1, units = {}, angleUnit = 1, numbers = {}} = {}) {
  const text = given.replaceAll("**", "^");
  const tokens = [];
  for (TOKEN.lastIndex = 0; TOKEN.lastIndex < text.trimEnd().length;) {
    const found = TOKEN.exec(text);
    if (!found) return NaN;
    tokens.push(found[1] !== undefined ? +found[1] : found[2] ?? found[3]);
  }
  let at = 0;
  const take = token => tokens[at] === token && ++at > 0;
  const sum = () => {
    let value = product();
    for (;;) if (take("+")) value += product(); else if (take("-")) value -= product(); else return value;
  };
  const product = () => {
    let value = signed();
    for (;;) if (take("*")) value *= signed(); else if (take("/")) value /= signed(); else return value;
  };
  const signed = () => (take("-") ? -signed() : take("+") ? signed() : power());
  const power = () => { const base = atom(); return take("^") ? base ** signed() : base; };
  const list = () => {
    const found = [sum()];
    while (take(",")) found.push(sum());
    return take(")") ? found : [NaN];
  };
  const atom = () => {
    const token = tokens[at++];
    if (typeof token === "number") return typeof tokens[at] === "string" && Object.hasOwn(units, tokens[at]) ? token * units[tokens[at++]] / unit : token;
    if (token === "(") { const value = sum(); return take(")") ? value : NaN; }
    if (token === "pi") return Math.PI;
    if (typeof token === "string" && Object.hasOwn(numbers, token)) return numbers[token];
    if (typeof token !== "string" || !take("(")) return NaN;
    const given = list();
    if (Object.hasOwn(FUNCTIONS, token)) return FUNCTIONS[token](...given);
    if (Object.hasOwn(TURNING, token)) return TURNING[token](given[0] * angleUnit);
    return Object.hasOwn(ANGLES_OF, token) ? ANGLES_OF[token](...given) / angleUnit : NaN;
  };
  const value = tokens.length ? sum() : NaN;
  return at === tokens.length ? value : NaN;
}

/** The names in an expression that are not those of functions. */
export const namesIn = text => (text.match(/[A-Za-zÀ-ɏα-ω_][\wÀ-ɏα-ω]*/g) ?? []).filter(name => name !== "pi" && ![FUNCTIONS, TURNING, ANGLES_OF].some(known => Object.hasOwn(known, name)));
