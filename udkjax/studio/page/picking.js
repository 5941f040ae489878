// The item under the cursor: the nearest pin, or else the topmost symbol near the cursor.

import {LISTS, list, nameOf, namesOf} from "./document.js";
import {isNear} from "./player/symbols.js";

const PIN_REACH = 11, SYMBOL_REACH = 7, TOUCH = 1.8;  // px; and the factor by which fingers reach farther

/** The pin nearest to a pixel and within reach, or null. `places` are the pins' positions in pixels. */
export function pinAt(places, pixel, touch = false, except = null) {
  let best = null, least = PIN_REACH * (touch ? TOUCH : 1);
  for (const [name, place] of places) {
    const away = Math.hypot(place[0] - pixel[0], place[1] - pixel[1]);
    if (name !== except && away < least) [best, least] = [name, away];
  }
  return best;
}

/** The item at a pixel, {kind, name or index}, or null. `outlines` are the symbols in pixels, the topmost last. */
export function itemAt(outlines, places, pixel, touch = false, kinds = null) {
  const reach = SYMBOL_REACH * (touch ? TOUCH : 1), fits = of => !kinds || kinds.includes(of.kind);
  const pin = fits({kind: "pin"}) ? pinAt(places, pixel, touch) : null;
  if (pin !== null) return {kind: "pin", name: pin};
  for (let k = outlines.length - 1; k >= 0; k--) {
    const {of, points, radius, closed, width} = outlines[k];
    if (!of || of.kind === "pin" || !fits(of)) continue;
    if (radius !== undefined) {
      if (Math.hypot(points[0][0] - pixel[0], points[0][1] - pixel[1]) <= Math.max(radius, reach)) return of;
      continue;
    }
    if (isNear(pixel, points, closed, Math.max(reach, width / 2 + 2))) return of;
  }
  return null;
}

/** The items within a rectangle of pixels. */
export function itemsWithin(document, places, [x0, y0], [x1, y1]) {
  const holds = ([x, y]) => x >= Math.min(x0, x1) && x <= Math.max(x0, x1) && y >= Math.min(y0, y1) && y <= Math.max(y0, y1);
  const pins = new Set([...places].filter(([, place]) => holds(place)).map(([name]) => name));
  const found = [], names = new Set(["ground", ...pins]);
  for (const kind of LISTS) {  // in an order in which each kind names pins and earlier kinds
    list(document, kind).forEach((entry, index) => {
      const named = namesOf(entry);
      if (!named.length || !named.every(name => names.has(name))) return;
      found.push({kind, index});
      names.add(nameOf(document, kind, index));
    });
  }
  return [...found, ...[...pins].map(name => ({kind: "pin", name}))];
}

/** True if two items are the same. */
export const same = (a, b) => a?.kind === b?.kind && a?.name === b?.name && a?.index === b?.index;
