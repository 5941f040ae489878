// The tools: names, keys, icons and actions. gestures.js turns presses, drags and releases into calls of these actions.

import * as actions from "./actions.js";
import {drawPin} from "./joining.js";

// kind "points": from one target to another, by a drag or by two clicks, or at one by `click` if the tool has it; "click": at one target; "corners": a click each.
export const TOOLS = [
  {name: "select", key: "v", title: "Select and move", icon: "M6 3l12 10h-6l3.5 7-2.8 1.3L9.5 14 6 18z"},
  {name: "pull", key: "h", title: "Pull: drag the mechanism; its loops stay closed", icon: "M8 12V6.5a1.5 1.5 0 0 1 3 0V11V4.5a1.5 1.5 0 0 1 3 0V11V6a1.5 1.5 0 0 1 3 0v8c0 4-2.5 7-6 7-3 0-4.5-1.5-6-4.5L3.5 13a1.5 1.5 0 0 1 2.6-1.5z"},
  {name: "link", key: "l", title: "Link: a bar between two pins", kind: "points", make: actions.drawLink, icon: "M5 21a3 3 0 1 1 2.1-5.1l8.8-8.8A3 3 0 1 1 18 9a3 3 0 0 1-.6-.100l-9 9A3 3 0 0 1 5 21z"},
  {name: "plate", key: "a", title: "Plate: click its pins, then the first one again", kind: "corners", make: actions.drawPlate, icon: "M4 19L11 4l10 10z"},
  {name: "disc", key: "b", title: "Disc: a wheel or a cam about a pin", kind: "points", make: actions.drawDisc, icon: "M12 3a9 9 0 1 1 0 18 9 9 0 0 1 0-18zm0 7.5a1.5 1.5 0 1 0 0 3 1.5 1.5 0 0 0 0-3z"},
  {name: "pin", key: "p", title: "Pin: joins bars where they cross, or a pin to the link under it", kind: "click", make: drawPin, icon: "M12 5a7 7 0 1 1 0 14 7 7 0 0 1 0-14zm0 4.500a2.500 2.500 0 1 0 0 5 2.500 2.500 0 0 0 0-5z"},
  {name: "ground", key: "g", title: "Ground: fix or free a pin", kind: "click", make: actions.drawGround, icon: "M12 3l6 10H6zM3 14h18v2H3zM5 17l-2 4M10 17l-2 4M15 17l-2 4M20 17l-2 4"},
  {name: "slide", key: "s", title: "Slide: guides a link along a line without turning", kind: "points", make: actions.drawSlide, icon: "M3 18h18v2H3zM6 8h12v8H6z"},
  {name: "slot", key: "k", title: "Slot: guides a pin along a line", kind: "points", make: actions.drawSlot, icon: "M6 8h12a4 4 0 0 1 0 8H6a4 4 0 0 1 0-8zm3 2a2 2 0 1 0 0 4 2 2 0 0 0 0-4z"},
  {name: "gear", key: "w", title: "Gear: two wheels that mesh", kind: "points", make: actions.drawGear, icon: "M11 2h2l.5 3 2.2.9 2.5-1.8 1.4 1.4-1.8 2.5.9 2.2 3 .5v2l-3 .5-.9 2.2 1.8 2.5-1.4 1.4-2.5-1.8-2.2.9-.5 3h-2l-.5-3-2.2-.9-2.5 1.8-1.4-1.4 1.8-2.5-.9-2.2-3-.5v-2l3-.5.9-2.2L4.4 5.5l1.4-1.4 2.5 1.8 2.2-.9zM12 9a3 3 0 1 0 0 6 3 3 0 0 0 0-6z"},
  {name: "cam", key: "c", title: "Cam: drag from its centre to the pin that it lifts", kind: "points", make: actions.drawCam, icon: "M12 4c5 0 9 4 8 9s-5 7-9 7-7-2.5-7-6 3-10 8-10zm-1 8a1.8 1.8 0 1 0 0 3.6 1.8 1.8 0 0 0 0-3.6z"},
  {name: "motor", key: "m", title: "Motor: click a pin or a slide, or drag from pin to pin for a cylinder", kind: "points", click: actions.drawMotor, make: actions.drawCylinder, icon: "M12 4a8 8 0 1 1-7.7 6l2 .5A6 6 0 1 0 12 6v3L7.5 5 12 1z"},
  {name: "spring", key: "r", title: "Spring: between two pins, or at one", kind: "points", make: actions.drawSpring, icon: "M2 12h3l2-6 3 12 3-12 3 12 2-6h4", stroke: true},
  {name: "damper", key: "d", title: "Damper: between two pins, or at one", kind: "points", make: actions.drawDamper, icon: "M2 12h8M10 8v8M8 6h9v12H8M17 12h5", stroke: true},
  {name: "load", key: "o", title: "Load: a force on a pin or a link", kind: "points", make: actions.drawLoad, icon: "M4 11h11V6l7 6-7 6v-5H4z"},
  {name: "path", key: "t", title: "Path: draw the path that a point shall take, and find a mechanism for it", kind: "stroke", icon: "M3 17c3-9 6-9 8-4s5 5 10-6l-1.8-.8c-4 8.800-5.500 8.800-6.800 4.800C10 5 5 5 1.200 16.300z"},
];

// The tool that sets the scale of a picture; its button is with the picture's.
const SCALE = {name: "scale", title: "Set the scale of the picture: drag between two of its points whose distance you know", kind: "points",
  make: (document, from, to) => ({measured: [from.free, to.free]})};

export const toolOf = name => (name === "scale" ? SCALE : TOOLS.find(tool => tool.name === name));

export const KEYS = [
  ["Ctrl Z", "undo"], ["Ctrl Y, Ctrl Shift Z", "redo"], ["Ctrl N or Alt N", "new"], ["Ctrl O, Ctrl S", "open, save"], ["Ctrl A", "select all"], ["Ctrl C, X, V", "copy, cut, paste, also into another drawing"], ["Ctrl D", "duplicate"], ["Delete", "delete"], ["Ctrl P", "print the drawing, its curves and answers"],
  ["Enter, or a digit", "type a place for the tool: A, or 12, 30, or 50 @ 60"], ["F", "fit the view"], ["Esc", "leave the tool"], ["Space", "play, pause"], ["Home", "back to the drawn position"], ["Arrows", "move the selection, or step through time"], ["Wheel", "zoom"],
  ["Drag the background", "pan"], ["Shift drag", "select an area"], ["Alt", "place without snapping"], ["Drop a pin on a pin", "merge them"],
  ...TOOLS.map(tool => [tool.key.toUpperCase(), tool.title]),
];
