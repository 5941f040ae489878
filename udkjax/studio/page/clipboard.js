// Copies of parts of a drawing: a fragment has the chosen elements, their pins and the named numbers of these, and is a small
// document of its own. It is put into a drawing, the same or another one, with fresh names.

import {LISTS, NAME_KEYS, addPin, freshName, groundOf, list, nameOf, namesOf, pinsOf, pinsOfItems, placeOf, shiftedPoints, toggleGround, withElement} from "./document.js";
import {referencesOf, withNames} from "./pin_forms.js";
import {namesIn} from "./expressions.js";
import {usesNumbers} from "./units.js";

const MARK = "udkjax drawing";  // the key of a fragment in the text of the clipboard
const ADDRESS = "drawing=";  // in the address of a shared drawing
const COPY_PIXELS = 24;  // between the original and its copy
const COORDINATE_KEYS = ["centre", "outline", "holes"];  // of a link, in the axes of the drawing

const textsIn = value => (typeof value === "string" ? [value] : value && typeof value === "object" ? Object.values(value).flatMap(textsIn) : []);

/** The named numbers that a value needs, those of their expressions included. */
function numbersFor(value, document) {
  const found = {}, waiting = textsIn(value);
  while (waiting.length) {
    const text = waiting.pop();
    for (const name of usesNumbers(text, document) ? namesIn(text) : []) {
      if (Object.hasOwn(found, name)) continue;
      found[name] = document.numbers[name];
      waiting.push(...textsIn(found[name]));
    }
  }
  return found;
}

/** The chosen elements of a drawing as a document of their own: `places` are those of its pins (m). */
export function fragmentOf(document, items) {
  const pins = Object.fromEntries(pinsOfItems(document, items).map(name => [name, pinsOf(document)[name]]));
  const chosen = Object.fromEntries(LISTS.map(section => [section, list(document, section)
    .map((entry, index) => (items.some(item => item.kind === section && item.index === index) ? {name: nameOf(document, section, index), ...entry} : null)).filter(Boolean)]));
  const found = {units: document.units ?? {}, pins, ground: groundOf(document).filter(name => Object.hasOwn(pins, name)), ...chosen};
  const places = Object.fromEntries(Object.keys(pins).map(name => [name, placeOf(document, name)]));
  return {...found, numbers: numbersFor(found, document), places};
}

const sameUnits = (a, b) => JSON.stringify(Object.entries(a ?? {}).sort()) === JSON.stringify(Object.entries(b ?? {}).sort());

/**
 * The document with a fragment, (dx, dy) metres away, the items that are new, and a `note` of elements that are left out. Names
 * of other elements, such as the pin of a motor, are those of the drawing. `problem` if it does not fit.
 */
export function withFragment(document, fragment, dx, dy) {
  const isBlank = !Object.keys(pinsOf(document)).length;
  if (!isBlank && !sameUnits(document.units, fragment.units)) return {problem: "what was copied has other units than this drawing: give both drawings the same"};
  const numbers = {...fragment.numbers, ...document.numbers};
  let found = {...document, ...(isBlank ? {units: fragment.units} : {}), ...(Object.keys(numbers).length ? {numbers} : {})};
  const changed = Object.keys(fragment.numbers).filter(name => Object.hasOwn(document.numbers ?? {}, name) && document.numbers[name] !== fragment.numbers[name]);
  const names = new Map(), select = [], swap = name => names.get(name) ?? name, again = value => (Array.isArray(value) ? value.map(swap) : swap(value));
  for (const pin of Object.keys(fragment.pins)) {
    const [x, y] = fragment.places[pin] ?? [0, 0];
    let name;
    [found, name] = addPin(found, [x + dx, y + dy]);
    if (fragment.ground.includes(pin)) found = toggleGround(found, name);
    names.set(pin, name);
    select.push({kind: "pin", name});
  }
  const forms = Object.entries(fragment.pins).filter(([, value]) => { const named = referencesOf(value); return named.length && named.every(name => names.has(name)); });
  found = {...found, pins: {...pinsOf(found), ...Object.fromEntries(forms.map(([pin, value]) => [names.get(pin), withNames(value, swap)]))}};
  const gone = [];
  for (const section of LISTS) {
    for (const {name, ...entry} of fragment[section] ?? []) {
      const known = new Set(["ground", ...Object.keys(pinsOf(found)), ...LISTS.flatMap(s => list(found, s).map((_, k) => nameOf(found, s, k)))]);
      const own = {...entry, ...Object.fromEntries(NAME_KEYS.filter(key => key in entry).map(key => [key, again(entry[key])])),
        ...Object.fromEntries(COORDINATE_KEYS.filter(key => Array.isArray(entry[key])).map(key => [key, shiftedPoints(entry[key], found, dx, dy)]))};
      const missing = namesOf(own).find(one => !known.has(one));
      if (missing) { gone.push(`${name} is left out: ${missing} is not in this drawing`); continue; }
      const fresh = freshName(found, name.replace(/\d+$/, ""));
      found = withElement(found, section, {name: fresh, ...own});
      names.set(name, fresh);
      select.push({kind: section, index: list(found, section).length - 1});
    }
  }
  const note = [...gone, ...changed.map(name => `${name} stays ${document.numbers[name]}`)].join("; ");
  return {document: found, select, note};
}

/** Add a copy of the selection, a little away. */
export function copy(studio) {
  if (!studio.selection.length) return studio.say("select something to duplicate it");
  return paste(studio, fragmentOf(studio.document, studio.selection));
}

/** Put a copied part into the drawing, as far away from where it was that no pin lies on another one. */
function paste(studio, fragment) {
  const away = COPY_PIXELS / studio.view.scale, snapped = studio.snap([away, -away], {altKey: false}), step = snapped.map((x, k) => x || [away, -away][k]);
  const taken = Object.keys(pinsOf(studio.document)).map(name => placeOf(studio.document, name)).filter(Boolean), placed = Object.values(fragment.places).filter(Boolean);
  const isFree = shift => !placed.some(([x, y]) => taken.some(([u, w]) => Math.hypot(x + shift[0] - u, y + shift[1] - w) < 0.5 * away));
  let shift = [0, 0];
  for (let k = 0; k <= taken.length && !isFree(shift); k++) shift = shift.map((x, i) => x + step[i]);
  const {document, select, note, problem} = withFragment(studio.document, fragment, ...shift);
  if (problem) return studio.say(problem, true);
  if (select.length) studio.commit(document, select);
  return studio.say(note);
}

/** Let the clipboard of the system take what is selected, and give it back, in this drawing or another one. */
export function followClipboard(studio, isTyping, remove) {
  const isOurs = event => !isTyping(event.target) && !document.querySelector("dialog[open]") && !String(getSelection());
  const take = event => {
    if (!isOurs(event) || !studio.selection.length) return false;
    event.clipboardData.setData("text/plain", JSON.stringify({[MARK]: fragmentOf(studio.document, studio.selection)}));
    event.preventDefault();
    return true;
  };
  window.addEventListener("copy", take);
  window.addEventListener("cut", event => { if (take(event)) remove(studio); });
  window.addEventListener("paste", event => {
    if (!isOurs(event)) return;
    const text = event.clipboardData.getData("text/plain"), fragment = readFragment(text);
    event.preventDefault();
    if (fragment) paste(studio, fragment);
    else if (text.includes(ADDRESS)) studio.files.unlessChanged(() => studio.files.openAddress(text));
    else studio.say("the clipboard has neither a part nor the address of a drawing: copy one with Ctrl C, or under Share");
  });
}

function readFragment(text) {
  try {
    const {[MARK]: found} = JSON.parse(text);
    return found && [found.pins, found.places, found.numbers].every(part => typeof part === "object") ? found : null;
  } catch { return null; }
}
