// Keyboard shortcuts, as in other drawing programs.

import {copy, followClipboard} from "./clipboard.js";
import {LISTS, list, pinsOfItems, pinsOf, removeElements, settle, shiftPins} from "./document.js";
import {TOOLS} from "./tools.js";

const TIME_STEPS = 100;  // presses of an arrow key through a whole run
const typing = target => ["INPUT", "TEXTAREA", "SELECT"].includes(target.tagName) && target.type !== "range" && target.type !== "checkbox";

export function followKeys(studio) {
  followClipboard(studio, typing, remove);
  window.addEventListener("keydown", event => {
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key, command = event.ctrlKey || event.metaKey;
    const isNew = event.altKey && event.code === "KeyN";  // for browsers that keep Ctrl+N to themselves
    const action = isNew ? () => studio.files.startNew() : command ? commands(studio, event)[key] : plain(studio)[key];
    if (!action || (event.altKey && !isNew) || document.querySelector("dialog[open]")) return;
    if (typing(event.target) && !(command && "sno".includes(key))) return;
    if (key === " " && event.target.tagName === "BUTTON") return;  // a button takes the space bar itself
    event.preventDefault();
    action();
  });
}

const commands = (studio, event) => ({
  z: () => (event.shiftKey ? studio.redo() : studio.undo()),
  y: () => studio.redo(),
  s: () => studio.files.save(event.shiftKey),
  n: () => studio.files.startNew(),
  o: () => studio.files.showOpen(),
  d: () => copy(studio),
  a: () => studio.select(everything(studio.document)),
});

const plain = studio => ({
  Delete: () => remove(studio),
  Backspace: () => remove(studio),
  Escape: () => { if (!studio.gestures.cancel()) { if (studio.tool !== "select") studio.setTool("select"); else studio.select([]); } },
  Enter: () => studio.gestures.finish() || studio.entry.open(),
  ...Object.fromEntries([..."0123456789.-"].map(key => [key, () => studio.entry.open(key)])),
  ArrowLeft: () => nudge(studio, -1, 0),
  ArrowRight: () => nudge(studio, 1, 0),
  ArrowUp: () => nudge(studio, 0, 1),
  ArrowDown: () => nudge(studio, 0, -1),
  Home: () => studio.rewind(),
  " ": () => studio.motion.toggle(),
  f: () => studio.fit(),
  "?": () => studio.showHelp(),
  ...Object.fromEntries(TOOLS.map(tool => [tool.key, () => studio.setTool(tool.name)])),
});

/** Move the selection by one grid step. Without a selection, or away from the drawn position, step through time. */
function nudge(studio, x, y) {
  const pins = pinsOfItems(studio.document, studio.selection), step = studio.gridUnit();
  if (pins.length && !studio.isMoved) return studio.commit(settle(shiftPins(studio.document, pins, x * step, y * step)));
  studio.motion.pause();
  return studio.motion.seek(studio.motion.t + (x || y) * studio.motion.end / TIME_STEPS);
}

/** All pins and elements of a drawing. */
const everything = document => [...Object.keys(pinsOf(document)).map(name => ({kind: "pin", name})),
  ...LISTS.flatMap(kind => list(document, kind).map((_, index) => ({kind, index})))];

export function remove(studio) {
  if (studio.selection.length) studio.commit(removeElements(studio.document, studio.selection), []);
}
