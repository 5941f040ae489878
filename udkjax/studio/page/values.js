// Values of a file as the text of a field, and back: numbers, texts with units, lists, tables.

/** A value as it would be typed: 12, "12 mm" without its quotes, [1, 2], A, B. */
export function valueText(value) {
  if (value === undefined || value === null) return "";
  if (Array.isArray(value)) return value.every(x => typeof x === "string" && /^[^\s,[\]{}"]+$/.test(x) && !/^[-+.\d]/.test(x)) ? value.join(", ") : `[${value.map(valueText).join(", ")}]`;
  if (typeof value === "number") return String(+value.toPrecision(15));  // 0.5 for 0.5000000000000001
  return typeof value === "object" ? JSON.stringify(value) : String(value);
}

/** The value of a typed text; undefined if it is empty. `isName` keeps texts that look like numbers. */
export function readValue(text, isName = false) {
  const plain = text.trim();
  if (plain === "") return undefined;
  if (plain.startsWith("{")) {
    try { return JSON.parse(plain); } catch { return plain; }
  }
  if (plain.startsWith("[") && plain.endsWith("]")) return parts(plain.slice(1, -1)).map(part => readValue(part, isName)).filter(x => x !== undefined);
  if (isName) return plain.includes(",") ? plain.split(",").map(x => x.trim()).filter(Boolean) : plain;
  if (plain === "true" || plain === "false") return plain === "true";
  return /^[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$/.test(plain) && Number.isFinite(+plain) ? +plain : plain;
}

/** The parts of a list, at commas outside of brackets. */
function parts(text) {
  const found = [""];
  let deep = 0;
  for (const c of text) {
    deep += c === "[" || c === "{" ? 1 : c === "]" || c === "}" ? -1 : 0;
    if (c === "," && deep === 0) found.push(""); else found[found.length - 1] += c;
  }
  return found;
}
