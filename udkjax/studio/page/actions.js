// Actions of the drawing tools: each takes a document and targets, and returns {document, select} or {problem}.
//
// A target is the beginning or the end of a gesture: {place} in metres, with the `pin`, or the `link` and the `slide` (indices), under it.

import {addPin, freshName, groundOf, list, members, nameOf, placeOf, project, movePin, withElement, withEntry, toggleGround} from "./document.js";
import {addPinToLink, loosePins} from "./joining.js";
import {centrePin, corners} from "./shapes.js";
import {angleUnit, lengthUnit, niceBelow, tidy, written} from "./units.js";

const STEEL = {density: 7850};  // kg/m^3
const BAR = {width: 0.01, thickness: 0.002};  // m: of a new link, whatever the zoom, so that its mass depends on its length alone
const OTHER_SCALE = 10;  // ratio of the size that suits the view to the usual one, from which on new links have another size
const PIXELS_PER_NEWTON = 5;
const TEETH = 20;
const LIFT = 0.4, CAM_POINTS = 12;  // lift of a new cam as a fraction of the radius at its follower, and knots of its profile

const last = (document, section) => ({kind: section, index: list(document, section).length - 1});

/** The document with a pin at a target, and its name. */
function pinFor(document, {pin, link, place}) {
  if (pin !== undefined && pin !== null) return [document, pin];
  if (link !== undefined && link !== null) return addPinToLink(document, link, place);
  return addPin(document, place);
}

/** Width and thickness of a new link: those of the last one, or of the usual bar, or sizes that suit a view of much larger or smaller links. */
function section(document, size) {
  const old = list(document, "link").filter(link => link.density !== undefined && link.thickness !== undefined && link.pins.length > 1).at(-1);
  const isUsual = size < OTHER_SCALE * BAR.width && BAR.width < OTHER_SCALE * size, unit = lengthUnit(document);
  const [width, thickness] = isUsual ? [BAR.width, BAR.thickness].map(x => tidy(x / unit)) : [size, size / 5].map(x => tidy(niceBelow(x) / unit));
  return {density: old?.density ?? STEEL.density, width: old?.width ?? width, thickness: old?.thickness ?? thickness};
}

const isApart = (document, a, b) => { const [p, q] = [a, b].map(pin => placeOf(document, pin)); return p[0] !== q[0] || p[1] !== q[1]; };

export function drawLink(document, from, to, {size}) {
  let [found, a] = pinFor(document, from), b;
  [found, b] = pinFor(found, to);
  if (a === b || !isApart(found, a, b)) return {problem: "a link needs two pins: drag from one point to another"};
  if (list(document, "link").some(link => link.pins.length === 2 && link.pins.includes(a) && link.pins.includes(b))) {
    return {problem: `a link already joins ${a} and ${b}`};
  }
  found = withElement(found, "link", {name: freshName(found, "link"), pins: [a, b], ...section(document, size)});
  return {document: found, select: [last(found, "link")]};
}

export function drawPlate(document, targets, {size}) {
  let found = document, pin;
  const pins = [];
  for (const target of targets) {
    [found, pin] = pinFor(found, target);
    if (!pins.includes(pin)) pins.push(pin);
  }
  if (pins.length < 3 || !corners(pins.map(name => placeOf(found, name)))[1]) return {problem: "a plate needs at least three pins that are not in line"};
  const {width, ...rest} = section(document, size);
  found = withElement(found, "link", {name: freshName(found, "link"), pins, ...rest});
  return {document: found, select: [last(found, "link")]};
}

export function drawDisc(document, from, to, {size}) {
  const [found, pin] = pinFor(document, from), centre = placeOf(found, pin);
  const radius = Math.hypot(to.place[0] - centre[0], to.place[1] - centre[1]) || 2 * size;
  const width = written(2 * radius, document), thickness = tidy(niceBelow(size / 2) / lengthUnit(document));
  const made = withElement(found, "link", {name: freshName(found, "disc"), pins: [pin], ...STEEL, width, thickness});
  return {document: made, select: [last(made, "link")]};
}

/** Fix a pin to the ground, or free it; elsewhere a new pin is fixed, of the link under it if there is one. */
export function drawGround(document, target) {
  const [found, name] = pinFor(document, target);
  return {document: toggleGround(found, name), select: [{kind: "pin", name}]};
}

/** The two members between which an element at a pin acts, as `of`; a problem if there are fewer than two. */
function pairAt(document, pin, what) {
  const met = members(document, pin), slot = list(document, "slot").findIndex(entry => entry.pin === pin);
  if (met.length < 2 && slot >= 0) return {problem: `only ${nameOf(document, "slot", slot)} holds ${pin}: to drive it along the line, replace the slot by a slide (S)`};
  if (met.length < 2) {
    return {problem: `${what} acts between two links, or between a link and the ground, but ${met.length ? `only ${met[0]}` : "nothing"} is at ${pin}: fix the pin to the ground (G)`};
  }
  return met.length > 2 ? {of: met.slice(0, 2)} : {};
}

/** The slide of a link, or of a pin that is alone on its link and whose only member that is; -1 if there is none. */
function slideAt(document, {pin, link, slide}) {
  const alone = pin && members(document, pin).length < 2 ? list(document, "link").find(one => one.pins?.length === 1 && one.pins[0] === pin) : null;
  const guided = (alone ?? list(document, "link")[link])?.name, found = list(document, "slide").findIndex(entry => guided && entry.link === guided);
  return found >= 0 ? found : pin ? -1 : slide ?? -1;
}

/** A motor at a pin or a slide; a click on one that is there selects it. */
export function drawMotor(document, target) {
  const {pin, place} = target, slide = slideAt(document, target), name = slide >= 0 ? nameOf(document, "slide", slide) : null;
  if (name === null && !pin) return {problem: "a motor turns a link at a pin, or moves a slide: click one of these, or drag from pin to pin for a cylinder"};
  const present = list(document, "motor").findIndex(motor => (name === null ? motor.pin === pin : motor.slide === name));
  if (present >= 0) return {document, select: [{kind: "motor", index: present}]};
  const pair = name === null ? pairAt(document, pin, "a motor") : {};
  if (pair.problem) return pair;
  const made = withElement(document, "motor", name === null ? {pin, speed: "60 rpm", ...pair} : {slide: name, speed: "0.1 m/s"});
  return {document: made, select: [last(made, "motor")], place};
}

/** A cylinder: a motor that changes the distance between two pins. */
export const drawCylinder = (document, from, to) => drawBetween(document, from, to, "motor", {speed: "0.1 m/s"}, {speed: "60 rpm"});

const vector = angle => [Math.cos(angle), Math.sin(angle)].map(x => tidy(Math.round(x * 1e9) / 1e9));
const directionOf = (from, to) => {
  const dx = to.place[0] - from.place[0], dy = to.place[1] - from.place[1];
  if (Math.hypot(dx, dy) === 0) return [1, 0];
  const angle = Math.round(Math.atan2(dy, dx) / (Math.PI / 36)) * (Math.PI / 36);  // five degrees
  return vector(angle);
};

export function drawSlide(document, from, to, {size}) {
  const links = list(document, "link");
  let found = document, name = links[from.link]?.name;
  if (from.pin) {
    const single = links.find(link => link.pins.length === 1 && link.pins[0] === from.pin);
    if (single) name = single.name;
    else {
      name = freshName(document, "slider");
      found = withElement(found, "link", {name, pins: [from.pin], mass: "0.5 kg", width: tidy(niceBelow(3 * size) / lengthUnit(document))});
    }
  }
  if (!name) return {problem: "a slide guides a link along a line: drag from a pin or a link in that direction"};
  if (list(document, "slide").some(slide => slide.link === name)) return {problem: `${name} already has a slide`};
  const on = to.link !== undefined && to.link !== null && links[to.link].name !== name ? links[to.link] : null;
  const line = on && on.pins.length > 1 ? {along: [on.pins[0], on.pins.at(-1)], on: on.name} : {direction: directionOf(from, to)};
  found = withElement(found, "slide", {name: freshName(found, "slide"), link: name, ...line});
  return {document: found, select: [last(found, "slide")]};
}

export function drawSlot(document, from, to) {
  if (!from.pin) return {problem: "a slot guides a pin along a line: drag from a pin in that direction, or onto the link with the slot"};
  const under = to.pin && loosePins(document).find(({pin, link}) => pin === from.pin && list(document, "link")[link].pins.includes(to.pin));  // along a bar, to its end
  const on = list(document, "link")[under ? under.link : to.link ?? -1] ?? null;
  let found = document, line;
  const own = members(document, from.pin).filter(name => name !== "ground");
  if (on && on.pins.length > 1 && !on.pins.includes(from.pin)) {
    const along = [on.pins[0], on.pins.at(-1)], ends = along.map(pin => placeOf(document, pin));
    if (own.some(name => list(document, "link").find(l => l.name === name)?.pins.length)) found = movePin(found, from.pin, project(placeOf(document, from.pin), ...ends));
    line = {along, on: on.name};
  } else line = {direction: directionOf(from, to)};
  if (!own.length) return {problem: `a slot guides a pin of a link, but no link goes through ${from.pin}`};
  if (groundOf(document).includes(from.pin) && !line.on) return {problem: `${from.pin} is fixed to the ground: free it first (G)`};
  found = withElement(found, "slot", {pin: from.pin, ...line});
  return {document: found, select: [last(found, "slot")]};
}

export function drawGear(document, from, to) {
  const links = list(document, "link");
  const pick = target => links[target.link]?.name ?? (target.pin ? wheelAt(document, target.pin) : undefined);
  const names = [pick(from), pick(to)];
  if (!names[0] || !names[1] || names[0] === names[1]) return {problem: "gears join two links that turn about pins on the ground: drag from one to the other"};
  const pins = names.map(name => centrePin(document, name));
  const centreless = names.find((_, k) => pins[k] === null);
  if (centreless) return {problem: `${centreless} must be joined to the ground by one pin, its centre`};
  const widths = names.map(name => parseFloat(links.find(link => link.name === name).width));
  const discs = names.every(name => links.find(link => link.name === name).pins.length === 1) && widths.every(w => w > 0);
  const teeth = discs ? [TEETH, Math.max(4, Math.round(TEETH * widths[1] / widths[0]))] : [TEETH, TEETH];
  const made = withElement(document, "gear", {links: names, teeth});
  return {document: made, select: [last(made, "gear")]};
}

function wheelAt(document, pin) {
  const found = members(document, pin).filter(name => name !== "ground");
  const disc = found.find(name => list(document, "link").find(link => link.name === name)?.pins.length === 1);
  return disc ?? (found.length === 1 ? found[0] : undefined);
}

export function drawCam(document, from, to) {
  const links = list(document, "link");
  const centre = from.pin ?? (links[from.link]?.pins.length === 1 ? links[from.link].pins[0] : undefined);
  if (!to.pin && links[to.link] && to.link !== from.link) {  // a pin of the follower, where the drag ends
    const [made, pin] = addPinToLink(document, to.link, to.place);
    return drawCam(made, from, {...to, pin});
  }
  if (!centre || !to.pin || centre === to.pin) return {problem: "a cam turns about one pin and lifts another: drag from its centre to the follower, or its pin"};
  const cam = wheelAt(document, centre), follower = members(document, to.pin).filter(name => name !== "ground");
  if (!cam) return {problem: `the cam needs a link of its own at ${centre}: draw a disc there (B)`};
  if (!follower.length || follower.includes(cam)) return {problem: `${to.pin} must be a pin of the follower, not of the cam`};
  const [c, p] = [placeOf(document, centre), placeOf(document, to.pin)], pins = links.find(link => link.name === cam).pins;
  const [a, b] = pins.map(pin => placeOf(document, pin)), turned = b ? Math.atan2(b[1] - a[1], b[0] - a[0]) : 0;
  const radius = Math.hypot(p[0] - c[0], p[1] - c[1]), phase = Math.atan2(p[1] - c[1], p[0] - c[0]) - turned;
  const angles = Array.from({length: CAM_POINTS}, (_, k) => 2 * Math.PI * k / CAM_POINTS);
  const first = ((phase % (2 * Math.PI)) + 2 * Math.PI) % (2 * Math.PI) % (2 * Math.PI / CAM_POINTS);  // so that the follower is at a knot
  const profile = {
    angle: angles.map(x => tidy(Math.round((x + first) / angleUnit(document) * 1e9) / 1e9)),
    radius: angles.map(x => written(radius * (1 + LIFT * (1 - Math.cos(x + first - phase)) / 2), document)),
  };
  const many = follower.length > 1 || members(document, centre).filter(name => name !== "ground").length > 1;
  const made = withElement(document, "cam", {pins: [centre, to.pin], profile, ...(many ? {links: [cam, follower[0]]} : {})});
  return {document: made, select: [last(made, "cam")]};
}

/** A spring, a damper or a cylinder between two pins, or a torsional one at a single pin. New pins are fixed to the ground. */
function drawBetween(document, from, to, kind, law, turning) {
  if (from.pin && (to.pin === from.pin || to.isClick)) {
    const pair = pairAt(document, from.pin, kind === "motor" ? "a motor" : `a torsion ${kind}`);
    if (pair.problem) return pair;
    const made = withElement(document, kind, {pin: from.pin, ...pair, ...turning});
    return {document: made, select: [last(made, kind)]};
  }
  let found = document, pin;
  const between = [];
  for (const target of [from, to]) {
    const isNew = !target.pin && (target.link === undefined || target.link === null);
    [found, pin] = pinFor(found, target);
    if (isNew) found = toggleGround(found, pin);
    between.push(pin);
  }
  if (between[0] === between[1] || !isApart(found, ...between)) return {problem: `a ${kind === "motor" ? "cylinder" : kind} needs two pins: drag from one point to another`};
  const shared = members(found, between[0]).filter(name => members(found, between[1]).includes(name));
  if (shared.length) return {problem: `both ends are on ${shared[0]}: their distance never changes`};
  found = withElement(found, kind, {between, ...law});
  return {document: found, select: [last(found, kind)]};
}

export const drawSpring = (document, from, to) => drawBetween(document, from, to, "spring", {stiffness: "1 N/mm"}, {stiffness: "10 N m/rad"});
export const drawDamper = (document, from, to) => drawBetween(document, from, to, "damper", {damping: "10 N s/m"}, {damping: "0.1 N m s/rad"});

export function drawLoad(document, from, to, {scale}) {
  const way = [to.place[0] - from.place[0], to.place[1] - from.place[1]].map(x => Math.round(x * scale / PIXELS_PER_NEWTON));
  const force = way[0] || way[1] ? way : [0, -10];
  let found = document, target = {};
  if (from.pin) target = {pin: from.pin};
  else if (from.link !== undefined && from.link !== null) {
    const [made, pin] = addPinToLink(document, from.link, from.place);
    [found, target] = [made, {pin}];
  } else return {problem: "a load acts on a pin or a link: drag from it in the direction of the force"};
  if (!members(found, target.pin).some(name => name !== "ground")) return {problem: `there is no link at ${target.pin}`};
  found = withElement(found, "load", {...target, force: force.map(x => `${x} N`)});
  return {document: found, select: [last(found, "load")]};
}

/** The document with the two links of an element at a pin swapped. */
export const swapPair = (document, section, index) => withEntry(document, section, index, entry => ({...entry, of: [...entry.of].reverse()}));
