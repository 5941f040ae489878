// Fixes of redundant constraints as changes of the drawing: an element is removed, or a pin becomes a slot in one of its two links.

import {LISTS, list, members, nameOf, pinsOf, removeElements, toggleGround, withElement, withEntry} from "./document.js";
import {lengthUnit, tidy} from "./units.js";

/** The document after a fix {constraint, drawn}, or null if the drawing cannot express it.
 *
 *  A link that loses the pin keeps its mass, inertia and centre: they become numbers in the file, taken from `scene`.
 */
export function applyFix(document, {constraint, drawn}, scene) {
  if (drawn?.kind === "remove") {
    const found = LISTS.flatMap(kind => list(document, kind).map((_, index) => ({kind, index})))
      .find(({kind, index}) => kind !== "link" && nameOf(document, kind, index) === constraint);
    return found ? removeElements(document, [found]) : null;
  }
  if (drawn?.kind !== "slot" || !Object.hasOwn(pinsOf(document), constraint)) return null;
  const met = members(document, constraint), {on, link} = drawn;
  if (met.length !== 2 || !met.includes(on) || !met.includes(link)) return null;
  const direction = drawn.direction.map(x => tidy(Math.round(x * 1e12) / 1e12));
  const slot = {pin: constraint, direction, ...(on === "ground" ? {} : {on})};
  if (on === "ground") return withElement(toggleGround(document, constraint), "slot", slot);
  const index = list(document, "link").findIndex(entry => entry.name === on), freed = keepBody(document, index, scene, constraint);
  return freed && withElement(freed, "slot", slot);
}

/** The document with a link that has lost a pin but is the same body. */
function keepBody(document, index, scene, pin) {
  const {pins, density, thickness, width, outline, mass, inertia, centre, ...rest} = list(document, "link")[index];
  const k = scene.bodies.indexOf(rest.name), left = pins.filter(name => name !== pin);
  if (k < 0 || !left.length) return null;
  const place = scene.frames[k].slice(0, 2).map(x => tidy(x / lengthUnit(document)));
  const body = {mass: `${scene.masses[k]} kg`, inertia: `${scene.inertias[k]} kg m2`, centre: place};
  return withEntry(document, "link", index, () => ({...rest, pins: left, ...body}));
}
