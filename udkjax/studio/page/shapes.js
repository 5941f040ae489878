// Geometry of a drawing's elements: hulls of plates, profiles of cams, wheels of gears. Metres and radians.

import {groundOf, list, members, placeOf, pinsOf} from "./document.js";
import {angle, direction, length, point} from "./units.js";

const THIN = 0.02;  // area of a plate over its length squared: a thinner one is meant as a bar
const STEP = 1e-5;  // rad: of the differences that give the envelope of a flat face
export const LAWS = {  // share of the lift over the share of the angle
  dwell: () => 0, cycloidal: x => x - Math.sin(2 * Math.PI * x) / (2 * Math.PI), harmonic: x => (1 - Math.cos(Math.PI * x)) / 2,
  "3-4-5": x => x ** 3 * (10 - 15 * x + 6 * x * x), "4-5-6-7": x => x ** 4 * (35 - 84 * x + 70 * x * x - 20 * x ** 3),
};
const IN_LINE = 1e-9;  // fraction of the size squared: points whose hull has a smaller area are in line

/** The corners of a link through points, and whether they enclose an area: the hull of a plate, or the ends of a bar. */
export function corners(points) {
  if (points.length < 3) return [points, false];
  const sorted = [...points].sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  const turn = (o, a, b) => (a[0] - o[0]) * (b[1] - o[1]) - (a[1] - o[1]) * (b[0] - o[0]);
  const half = list => {
    const chain = [];
    for (const p of list) {
      while (chain.length > 1 && turn(chain[chain.length - 2], chain[chain.length - 1], p) <= 0) chain.pop();
      chain.push(p);
    }
    return chain.slice(0, -1);
  };
  const hull = [...half(sorted), ...half(sorted.reverse())];
  const size = Math.hypot(sorted[0][0] - sorted.at(-1)[0], sorted[0][1] - sorted.at(-1)[1]) || 1;
  if (hull.length < 3 || area(hull) <= IN_LINE * size * size) {
    const far = [...points].sort((a, b) => a[0] - b[0] || a[1] - b[1]);
    return [[far[0], far.at(-1)], false];
  }
  return [hull, true];
}

export function area(points) {
  let sum = 0;
  points.forEach(([x, y], k) => { const [u, w] = points[(k + 1) % points.length]; sum += x * w - u * y; });
  return Math.abs(sum) / 2;
}

const files = new Map();  // outlines and holes (m) of the files that links name

/** Keep the outlines that the server has read from files, {file, outline, holes}. */
export function keepOutlines(found) { for (const {file, ...shape} of found) files.set(JSON.stringify(file), shape); }

/** The outline of a link and its holes, as lists of corners (m); null without an outline. */
function outlineOf(document, {outline, holes = []}) {
  if (outline === undefined) return null;
  if (!Array.isArray(outline)) return files.get(JSON.stringify(outline)) ?? null;
  const corners = points => (Array.isArray(points) ? points : [null]).map(p => [length(p?.[0], document), length(p?.[1], document)]);
  const found = {outline: corners(outline), holes: Array.isArray(holes) ? holes.map(corners) : []};
  return [found.outline, ...found.holes].every(points => points.every(p => p.every(Number.isFinite))) ? found : null;
}

/** The shape of a link: {kind: "line" or "plate", points, holes} through its pins or outline, or {kind: "disc", at, radius}. */
export function linkShape(document, link) {
  const places = (link.pins ?? []).map(pin => placeOf(document, pin)).filter(Boolean);
  const drawn = outlineOf(document, link);
  if (drawn) return {kind: "plate", points: drawn.outline, holes: drawn.holes};
  if (!places.length) return null;
  if (places.length === 1) {
    const centre = Array.isArray(link.centre) ? point(link.centre, document) : null;
    if (centre && Math.hypot(centre[0] - places[0][0], centre[1] - places[0][1]) > 0) return {kind: "line", points: [places[0], centre]};
    const width = length(link.width, document), mass = +link.mass, inertia = +link.inertia;
    const gyration = Number.isFinite(inertia / mass) ? Math.sqrt(inertia / mass) : 0;
    return {kind: "disc", at: places[0], radius: Number.isFinite(width) ? width / 2 : gyration};
  }
  if (link.width !== undefined && link.inertia === undefined) return {kind: "line", points: alongLine(places)};
  const [points, closed] = corners(places);
  return {kind: closed ? "plate" : "line", points};
}

/** The pins of a bar in their order along it; empty for another link. */
export function barPins(document, link) {
  const {pins = []} = link, places = pins.map(pin => placeOf(document, pin)), isBar = pins.length === 2 || (pins.length > 2 && link.width !== undefined && link.inertia === undefined && !link.outline);
  return isBar && places.every(Boolean) ? alongLine(places).map(place => pins[places.indexOf(place)]) : [];
}

/** Findings about plates whose pins are almost in line: as plates they have hardly any mass. */
export function thinPlates(document) {
  return list(document, "link").flatMap(link => {
    const places = (link.pins ?? []).map(pin => placeOf(document, pin)).filter(Boolean);
    if (link.width !== undefined || link.outline || link.inertia !== undefined || places.length < 3) return [];
    const [hull, closed] = corners(places), size = Math.max(...hull.map(p => Math.hypot(p[0] - hull[0][0], p[1] - hull[0][1])));
    return closed && area(hull) > THIN * size * size ? [] : [`the pins of ${link.name} are almost in line: a plate through them has hardly any mass; give it a width, and it is a bar`];
  });
}

function alongLine(places) {
  const [a, b] = [places[0], places.at(-1)];
  return [...places].sort((p, q) => (p[0] - q[0]) * (b[0] - a[0]) + (p[1] - q[1]) * (b[1] - a[1]));
}

/** The largest distance between pins along an axis (m), or `usual` if there are no two. */
export function extent(document, usual = 0.1) {
  const places = Object.keys(pinsOf(document)).map(pin => placeOf(document, pin)).filter(Boolean);
  if (places.length < 2) return usual;
  const along = k => Math.max(...places.map(p => p[k])) - Math.min(...places.map(p => p[k]));
  return Math.max(along(0), along(1)) || usual;
}

/** Places (m) that span a whole drawing: pins, corners of links, rims of discs, wheels and cams. */
export function extentPoints(document) {
  const found = Object.keys(pinsOf(document)).map(pin => placeOf(document, pin)).filter(Boolean);
  const rim = ([x, y], r) => found.push([x - r, y - r], [x + r, y + r]);
  for (const link of list(document, "link")) {
    const shape = linkShape(document, link);
    if (shape?.kind === "disc") rim(shape.at, shape.radius); else found.push(...shape?.points ?? []);
  }
  for (const gear of list(document, "gear")) {
    const wheels = gearWheels(document, gear);
    wheels?.radii.forEach((radius, k) => rim(placeOf(document, wheels.pins[k]), radius));
  }
  for (const cam of list(document, "cam")) found.push(...camOutline(document, cam, 12)?.points ?? []);
  return found;
}

/** The pin about which a link turns on its carrier; null if there is not exactly one. */
export function centrePin(document, link, carrier = "ground") {
  const pins = link === "ground" ? groundOf(document) : list(document, "link").find(entry => entry.name === link)?.pins ?? [];
  const shared = pins.filter(pin => members(document, pin).includes(carrier));
  return shared.length === 1 ? shared[0] : null;
}

/** The radii of a gear pair (m), and the pins at its centres; null if the drawing does not determine them. */
export function gearWheels(document, gear) {
  const pins = (gear.links ?? []).map(link => centrePin(document, link, gear.carrier ?? "ground"));
  const [one, two] = pins.map(pin => pin && placeOf(document, pin));
  if (!one || !two) return null;
  const sizes = (gear.radii ?? gear.teeth ?? []).map(x => (gear.radii ? length(x, document) : +x));
  const apart = gear.internal ? Math.abs(sizes[0] - sizes[1]) : sizes[0] + sizes[1];
  const scale = gear.radii ? 1 : Math.hypot(two[0] - one[0], two[1] - one[1]) / apart;
  const radii = sizes.map(size => size * scale);
  return radii.every(r => Number.isFinite(r) && r > 0) ? {pins, radii} : null;
}

/** The direction (rad) of the line of a slide or a slot in world coordinates. */
export function lineAngle(document, entry) {
  const [a, b] = (entry.along ?? []).map(pin => placeOf(document, pin));
  return a && b ? Math.atan2(b[1] - a[1], b[0] - a[0]) : direction(entry.direction, document);
}

/** The outline of a cam: its corners in world coordinates (m), and the name of its link; null if they are not determined. */
export function camOutline(document, cam, count = 144) {
  const [centre, follower] = cam.pins ?? [], at = placeOf(document, centre), moving = pin => members(document, pin).filter(name => name !== "ground");
  const link = cam.links?.[0] ?? moving(centre)[0], other = cam.links?.[1] ?? moving(follower)[0];
  if (!at || !link) return null;
  const pins = list(document, "link").find(entry => entry.name === link)?.pins ?? [], [a, b] = pins.map(pin => placeOf(document, pin));
  const turned = a && b ? Math.atan2(b[1] - a[1], b[0] - a[0]) : 0, isFlat = cam.face !== undefined;
  const contact = cam.profile?.law ? contactByLaws(document, cam, link, other, turned) : contactByPoints(document, cam, turned);
  if (!contact) return null;
  const points = Array.from({length: count}, (_, k) => {
    const turn = 2 * Math.PI * k / count, [r, phi] = contact(turn), [c, s] = [Math.cos(phi), Math.sin(phi)];
    const [before, after] = isFlat ? [contact(turn - STEP), contact(turn + STEP)] : [[0, 0], [0, 1]];
    const across = (after[0] - before[0]) / (after[1] - before[1]);  // the envelope of the positions of a flat face
    return [at[0] + r * c - across * s, at[1] + r * s + across * c];
  });
  return points.flat().every(Number.isFinite) ? {points, link, follower, other} : null;
}

/** The distance (m) of the follower of a cam, as drawn, from the centre of the cam, or from its flat face; NaN without places. */
export function followerDistance(document, {pins = [], face}) {
  const [centre, point] = pins.map(pin => placeOf(document, pin));
  if (!centre || !point) return NaN;
  const [x, y] = minus(point, centre), normal = direction(face, document);
  return face === undefined ? Math.hypot(x, y) : x * Math.cos(normal) + y * Math.sin(normal);
}

/** The distance of a follower from the centre of a cam by points, and its direction in world coordinates, over the turn. */
function contactByPoints(document, {profile}, turned) {
  const angles = (profile?.angle ?? []).map(x => angle(x, document)), radii = (profile?.radius ?? []).map(x => length(x, document));
  if (angles.length < 3 || angles.length !== radii.length || ![...angles, ...radii].every(Number.isFinite)) return null;
  const radius = periodicSpline(angles, radii);
  return turn => [radius(turn), turn + turned];
}

/** The same for a cam by laws, which has turned as far: its follower moves along its slide, or about its pivot, by the laws. */
function contactByLaws(document, cam, link, other, turned) {
  const {law, clockwise, start, angle: turns = [], swing} = cam.profile, sense = clockwise ? 1 : -1;
  const angles = turns.map(x => angle(x, document)), steps = swing ? swing.map(x => angle(x, document)) : (cam.profile.lift ?? []).map(x => length(x, document));
  const guide = guideOf(document, cam, link, other);
  if (!guide || angles.length !== law.length || steps.length !== law.length || !law.every(name => name in LAWS)) return null;
  const toward = start === undefined ? guide.toward : angle(start, document) + turned;
  return turn => {
    let left = ((turn % (2 * Math.PI)) + 2 * Math.PI) % (2 * Math.PI), travel = 0, k = 0;
    for (; k < law.length - 1 && left >= angles[k]; k++) { left -= angles[k]; travel += steps[k]; }
    const r = guide.distance(travel + steps[k] * LAWS[law[k]](left / angles[k]));
    return [r, toward + guide.sight(r) + sense * turn];
  };
}

/** The guide of the follower of a cam by laws: its distance at a travel, and its angle at a distance from the direction of its slide or pivot. */
function guideOf(document, {profile, face, pins}, link, other) {
  const [centre, point] = pins.map(pin => placeOf(document, pin)), base = length(profile.base, document);
  const given = key => (profile[key] === undefined ? undefined : length(profile[key], document));
  if (!point) return null;
  const arm = minus(point, centre), isFlat = face !== undefined, seen = isFlat ? direction(face, document) : Math.atan2(arm[1], arm[0]);
  const carriers = members(document, pins[0]).filter(name => name !== link);
  if (profile.swing) {
    const found = carriers.map(carrier => centrePin(document, other, carrier)), pivot = found.length === 1 && found[0] && placeOf(document, found[0]);
    if (!pivot) return null;
    const line = minus(pivot, centre), held = minus(point, pivot), toward = Math.atan2(line[1], line[0]);
    const signed = given("pivot") ?? Math.hypot(...line) * (Math.sin(seen - toward) >= 0 ? 1 : -1), c = Math.abs(signed), side = Math.sign(signed);
    const l = given("arm") ?? (isFlat ? held[0] * Math.cos(seen) + held[1] * Math.sin(seen) : Math.hypot(...held));
    const rest = Math.acos(isFlat ? (base - l) / c : (c * c + l * l - base * base) / (2 * c * l));
    return isFlat ? {toward, distance: s => l + c * Math.cos(rest - s), sight: r => side * Math.acos((r - l) / c)}
      : {toward, distance: s => Math.sqrt(c * c + l * l - 2 * c * l * Math.cos(rest + s)), sight: r => side * Math.acos((c * c + r * r - l * l) / (2 * c * r))};
  }
  const slide = list(document, "slide").find(({link: one, on = "ground"}) => (one === other && carriers.includes(on)) || (on === other && carriers.includes(one)));
  if (isFlat || !slide) return {toward: seen, distance: s => base + s, sight: () => 0};
  const line = lineAngle(document, slide), toward = Math.cos(line - seen) < 0 ? line + Math.PI : line;
  const e = given("eccentricity") ?? arm[1] * Math.cos(toward) - arm[0] * Math.sin(toward), way = Math.sqrt(base * base - e * e);
  return {toward, distance: s => Math.hypot(e, way + s), sight: r => Math.atan2(e, Math.sqrt(Math.max(r * r - e * e, 0)))};
}

const minus = ([x, y], [u, v]) => [x - u, y - v];

/** The periodic cubic spline through values at increasing angles within one turn. */
export function periodicSpline(angles, values) {
  const n = angles.length, turn = 2 * Math.PI, h = angles.map((x, k) => (k + 1 < n ? angles[k + 1] - x : angles[0] + turn - x));
  const rows = angles.map((_, k) => {
    const before = (k + n - 1) % n, after = (k + 1) % n, row = new Array(n + 1).fill(0);
    row[before] += h[before];
    row[k] += 2 * (h[before] + h[k]);
    row[after] += h[k];
    row[n] = 6 * ((values[after] - values[k]) / h[k] - (values[k] - values[before]) / h[before]);
    return row;
  });
  const bend = solve(rows);
  return angle => {
    const x = angles[0] + ((((angle - angles[0]) % turn) + turn) % turn);
    let k = n - 1;
    while (k > 0 && angles[k] > x) k--;
    const after = (k + 1) % n, s = x - angles[k], r = h[k] - s;
    return (bend[k] * r ** 3 + bend[after] * s ** 3) / (6 * h[k]) + (values[k] / h[k] - bend[k] * h[k] / 6) * r
      + (values[after] / h[k] - bend[after] * h[k] / 6) * s;
  };
}

/** The solution of linear equations, given as rows of n + 1 numbers, by elimination with pivoting. */
function solve(rows) {
  const n = rows.length;
  for (let k = 0; k < n; k++) {
    const pivot = rows.slice(k).reduce((best, row, i) => (Math.abs(row[k]) > Math.abs(rows[best][k]) ? k + i : best), k);
    [rows[k], rows[pivot]] = [rows[pivot], rows[k]];
    for (let i = k + 1; i < n; i++) {
      const factor = rows[i][k] / rows[k][k];
      if (factor) for (let j = k; j <= n; j++) rows[i][j] -= factor * rows[k][j];
    }
  }
  const x = new Array(n).fill(0);
  for (let k = n - 1; k >= 0; k--) {
    x[k] = (rows[k][n] - rows[k].slice(k + 1, n).reduce((sum, c, j) => sum + c * x[k + 1 + j], 0)) / rows[k][k];
  }
  return x;
}
