// The symbols of a drawing, as the player paints them (player/symbols.js): lines and circles in the frames of its links. In the
// drawn position each link's frame coincides with the ground's. `of` names the element of a symbol, so that it can be picked.

import {groundOf, list, members, nameOf, pinsOf, placeOf} from "./document.js";
import {camOutline, extent, gearWheels, lineAngle, linkShape} from "./shapes.js";
import {length} from "./units.js";

const MOST_TEETH = 200;  // of a wheel
const ROUND = 48;  // vertices of a circle drawn as a polyline
const MOST_STROKES = 200;  // hatching strokes of one line, which may extend far beyond the view
const RAIL = 0.25;  // half of a rail's length, as a fraction of the drawing's extent
const edge = body => `edge:${body}`, tint = body => `tint:${body}`;
const offsets = points => points.map(([x, y]) => [0, 0, x, y]);
const arc = (radius, from, to, count = ROUND) => Array.from({length: count}, (_, k) => {
  const a = from + (to - from) * k / (count - 1);
  return [radius * Math.cos(a), radius * Math.sin(a)];
});
const line = (frame, points, stroke, width, fill = "", closed = false) => ({frame, points, stroke, width, fill, closed});
const circle = (frame, radius, fill = "", stroke = "", width = 1.5) => ({frame, radius: [...radius, 0, 0].slice(0, 3), fill, stroke, width});
const at = (body, [x, y], angle = 0, turns = 1) => [body, x, y, angle, turns];

function* hatch(frame, from, to, step, y, metres = 0) {
  if (!(to > from)) return;
  for (let x = from, wide = Math.max(step, (to - from) / MOST_STROKES); x < to; x += wide) {
    const start = metres ? [x, 0, 0, y] : [0, 0, x, y];
    yield line(frame, [start, [start[0], 0, start[2] - 5, y - 5]], "soft", 1);
  }
}

/** The symbols of a document, from back to front.
 *
 *  `unit` is the size (m) of one unit of symbols in the view, which sets the spacing of strokes. `paths` are the known paths of
 *  pins, {name, line: [x, y, ...]} in metres: a rail is as long as its pin travels.
 */
export function symbolsOf(document, unit, paths = []) {
  const draft = new Draft(document, unit, paths);
  return [...draft.cams, ...draft.rails, ...draft.plates, ...draft.wheels, ...draft.bars, ...draft.elements, ...draft.pins];
}

class Draft {
  constructor(document, unit, paths) {
    Object.assign(this, {document, unit, paths, cams: [], rails: [], plates: [], wheels: [], bars: [], elements: [], pins: []});
    this.number = new Map(list(document, "link").map((link, k) => [link.name, k]));
    this.size = extent(document);
    this.blocks = new Set(list(document, "slide").map(slide => slide.link));
    list(document, "link").forEach((link, k) => this.link(link, k));
    for (const section of ["slide", "slot", "gear", "cam", "motor", "spring", "damper", "load"]) {
      list(document, section).forEach((entry, index) => {
        const place = {kind: section, index};
        this.put = (layer, symbols) => this[layer].push(...[...symbols].map(symbol => ({...symbol, of: place})));
        this[section](entry);
      });
    }
    for (const name of Object.keys(pinsOf(document))) this.pin(name);
  }

  body(name) { return this.number.get(name) ?? -1; }
  place(pin) { return placeOf(this.document, pin); }

  /** The index of the last link of a pin, or -1 for the ground. */
  bodyOf(pin) {
    const names = members(this.document, pin);
    return names[0] === "ground" ? -1 : this.body(names.at(-1));
  }

  link(link, k) {
    const shape = linkShape(this.document, link), of = {kind: "link", index: k};
    if (!shape) return;
    if (shape.kind === "disc") {
      if (this.blocks.has(link.name)) return;  // drawn as a block
      const frame = at(k, shape.at);
      this.plates.push({...circle(frame, [shape.radius, 0, 8], tint(k), edge(k)), of});
      const reach = Math.max(0.85 * shape.radius, 0);
      if (reach > 0) this.plates.push({...line(frame, [[0, 0], [reach, 0]], edge(k), 1.3), of});
      return;
    }
    const closed = shape.kind === "plate", layer = closed ? "plates" : "bars";
    for (const [width, colour] of [[11, edge(k)], [8, tint(k)]]) {
      this[layer].push({...line([k, 0, 0, 0, 1], shape.points, colour, width, closed ? colour : "", closed), of});
    }
    for (const hole of shape.holes ?? []) this[layer].push({...line([k, 0, 0, 0, 1], hole, edge(k), 1.3, "back", true), of});
  }

  pin(name) {
    const place = this.place(name), of = {kind: "pin", name};
    if (!place) return;
    const body = this.bodyOf(name);
    if (groundOf(this.document).includes(name)) {
      const frame = at(-1, place, 0, 0), links = list(this.document, "link").filter(link => link.pins?.includes(name));
      const layer = links.some(link => link.pins.length === 1) ? "elements" : "rails";  // a wheel would hide it
      for (const symbol of [line(frame, offsets([[0, 0], [-10, -17], [10, -17]]), "soft", 1.4, "back", true),
        line(frame, offsets([[-15, -17], [15, -17]]), "soft", 1.4), ...hatch(frame, -10, 16, 5, -17)]) this[layer].push({...symbol, of});
    }
    this.pins.push({...circle(at(body, place), [0, 4.2], "back", "ink", 1.7), of});
  }

  slide(entry) {
    const pin = list(this.document, "link").find(link => link.name === entry.link)?.pins?.[0], place = pin && this.place(pin);
    const angle = lineAngle(this.document, entry), on = this.body(entry.on), k = this.body(entry.link);
    if (!place || !Number.isFinite(angle)) return;
    const [from, to] = this.span(pin, place, angle, on), frame = at(on, place, angle);
    this.put("rails", on >= 0 ? [line(frame, [[from, 0], [to, 0]], edge(on), 3)] : [
      line(frame, [[from, 0, 0, -9], [to, 0, 0, -9]], "soft", 1.5), ...hatch(frame, from + 5 * this.unit, to, 5 * this.unit, -9, 1)]);
    this.put("elements", [line(at(k, place, angle), offsets([[-15, -9], [15, -9], [15, 9], [-15, 9]]), edge(k), 1.5, tint(k), true)]);
  }

  /** The range along a line, from a place (m), over which a pin travels, with a margin at both ends. */
  span(pin, [x, y], angle, on) {
    const path = on < 0 ? this.paths.find(({name}) => name === pin)?.line : null;
    if (!path) return [-RAIL * this.size, RAIL * this.size];
    const c = Math.cos(angle), s = Math.sin(angle), margin = 24 * this.unit;
    let [from, to] = [0, 0];
    for (let k = 0; k < path.length; k += 2) {
      const along = c * (path[k] - x) + s * (path[k + 1] - y);
      [from, to] = [Math.min(from, along), Math.max(to, along)];
    }
    return [from - margin, to + margin];
  }

  slot(entry) {
    const pin = this.place(entry.pin), angle = lineAngle(this.document, entry), on = this.body(entry.on);
    if (!pin || !Number.isFinite(angle)) return;
    const ends = (entry.along ?? []).map(name => this.place(name));
    const span = ends.length === 2 && ends.every(Boolean) ? [0, Math.hypot(ends[1][0] - ends[0][0], ends[1][1] - ends[0][1])]
      : this.span(entry.pin, pin, angle, on);
    const start = ends[0] ?? pin, [a, b] = span, round = arc(6.5, -Math.PI / 2, Math.PI / 2, 9);
    const outline = [...round.map(([x, y]) => [b, 0, x, y]), ...round.map(([x, y]) => [a, 0, -x, -y])];
    this.put("bars", [line(at(on, start, angle), outline, on < 0 ? "soft" : edge(on), 1.3, "back", true)]);
    const guided = entry.link ?? members(this.document, entry.pin).find(name => name !== (entry.on ?? "ground"));
    this.put("pins", [circle(at(this.body(guided), pin), [0, 7], "", "ink", 1.4)]);
  }

  gear(entry) {
    const found = gearWheels(this.document, entry);
    if (!found) return;
    found.radii.forEach((radius, k) => {
      const body = this.body(entry.links[k]), internal = entry.internal && radius === Math.max(...found.radii);
      const own = Number.isInteger(entry.teeth?.[k]) && entry.teeth[k] > 3 ? entry.teeth[k] : Math.max(Math.round(2 * Math.PI * radius / (9 * this.unit) / 4) * 4, 12);
      const teeth = Math.min(own, MOST_TEETH), rim = [];
      const depth = Math.min(entry.teeth ? Math.PI * radius / teeth : 4 * this.unit, 0.12 * radius), frame = at(body, this.place(found.pins[k]));
      for (let i = 0; i < teeth; i++) for (const [turn, out] of [[0, -1], [0.25, -1], [0.35, 1], [0.65, 1], [0.75, -1]]) {
        const a = 2 * Math.PI / teeth * (i + turn), r = radius + out * depth / 2;
        rim.push([r * Math.cos(a), r * Math.sin(a)]);
      }
      if (internal) this.put("cams", [circle(frame, [radius + depth, 5], tint(body), edge(body))]);
      this.put(internal ? "cams" : "wheels", [line(frame, rim, edge(body), 1.3, internal ? "back" : tint(body), true)]);
      const spoke = `spoke:${body}`;
      if (!internal) this.put("wheels", [0, 1, 2].map(i => {
        const a = 2 * Math.PI * i / 3, inner = Math.min(9 * this.unit, 0.3 * radius), outer = 0.8 * radius;
        return line(frame, [[inner * Math.cos(a), inner * Math.sin(a)], [outer * Math.cos(a), outer * Math.sin(a)]], spoke, 2.2);
      }));
    });
  }

  cam(entry) {
    const outline = camOutline(this.document, entry);
    if (!outline) return;
    const k = this.body(outline.link), place = this.place(outline.follower);
    this.put("cams", [line([k, 0, 0, 0, 1], outline.points, edge(k), 1.6, tint(k), true)]);
    if (place) this.put("pins", [circle(at(this.body(outline.other), place), [0, 7], "", "ink", 1.4)]);
  }

  *turn(frame, radius, sign) {
    const points = arc(radius, -0.5, 3.5).map(([x, y]) => [x, sign * y]), way = [-Math.sin(3.5), sign * Math.cos(3.5)];
    yield line(frame, offsets(points), "accent", 1.8);
    yield this.head(frame, [points.at(-1)[0] + 4 * way[0], points.at(-1)[1] + 4 * way[1]], way);
  }

  head(frame, tip, [x, y]) {
    const back = [tip[0] - 7.5 * Math.cos(0.42) * x, tip[1] - 7.5 * Math.cos(0.42) * y], s = 7.5 * Math.sin(0.42);
    return line(frame, offsets([tip, [back[0] - s * y, back[1] + s * x], [back[0] + s * y, back[1] - s * x]]), "", 0, "accent", true);
  }

  motor(entry) {
    if (entry.slide !== undefined) {
      const index = list(this.document, "slide").findIndex((_, k) => nameOf(this.document, "slide", k) === entry.slide);
      const slide = list(this.document, "slide")[index], pin = slide && list(this.document, "link").find(l => l.name === slide.link)?.pins?.[0];
      const place = pin && this.place(pin), angle = slide ? lineAngle(this.document, slide) : NaN;
      if (!place || !Number.isFinite(angle)) return;
      const frame = at(this.body(slide.link), place, angle);
      this.put("elements", [line(frame, offsets([[-14, 15], [10, 15]]), "accent", 1.8), this.head(frame, [16, 15], [1, 0])]);
      return;
    }
    if (entry.between !== undefined) return void this.damper(entry);
    const place = this.place(entry.pin);
    if (!place) return;
    const value = String(entry.speed ?? entry.torque ?? "").trim();
    this.put("elements", this.turn(at(this.bodyOf(entry.pin), place, 0, 0), 13, value.startsWith("-") ? -1 : 1));
  }

  ends(entry) { return entry.between?.map(pin => { const place = this.place(pin); return place && [this.bodyOf(pin), ...place]; }); }

  spring(entry) {
    if (entry.pin !== undefined) {
      const place = this.place(entry.pin);
      if (place) this.put("elements", [line(at(this.bodyOf(entry.pin), place), offsets(Array.from({length: 61}, (_, k) => {
        const r = 5 + 8 * k / 60;
        return [r * Math.cos(-0.25 * k), r * Math.sin(-0.25 * k)];
      })), "ink", 1.3)]);
      return;
    }
    const frame = this.ends(entry);
    if (!frame?.every(Boolean) || frame.length !== 2) return;
    const long = Math.hypot(frame[1][1] - frame[0][1], frame[1][2] - frame[0][2]) / this.unit;
    const end = Math.min(0.15, 10 / Math.max(long, 10)), turns = 2 * Math.min(Math.max(Math.round(long / 11), 6), 24);
    const coil = Array.from({length: turns}, (_, k) => [end + (1 - 2 * end) * (k + 0.5) / turns, 0, 0, k % 2 ? -7 : 7]);
    this.put("elements", [line(frame, [[0, 0], [end, 0], ...coil, [1 - end, 0], [1, 0]], "ink", 1.5)]);
    if (entry.damping !== undefined) this.put("elements", this.piston(frame, -14));
  }

  damper(entry) {
    if (entry.pin !== undefined) {
      const place = this.place(entry.pin);
      if (place) this.put("elements", [circle(at(this.bodyOf(entry.pin), place), [0, 10], "", "ink", 1.2)]);
      return;
    }
    const frame = this.ends(entry);
    if (frame?.every(Boolean) && frame.length === 2) this.put("elements", this.piston(frame, 0));
  }

  *piston(frame, y) {
    yield line(frame, [[0, 0, 0, 0], [0, 0, 0, y], [0.5, 0, 0, y]], "ink", 1.5);
    yield line(frame, [[0.5, 0, 0, y - 4], [0.5, 0, 0, y + 4]], "ink", 2.2);
    yield line(frame, [[0.38, 0, 0, y + 7], [0.62, 0, 0, y + 7], [0.62, 0, 0, y - 7], [0.38, 0, 0, y - 7]], "ink", 1.5);
    yield line(frame, [[0.62, 0, 0, y], [1, 0, 0, y], [1, 0, 0, 0]], "ink", 1.5);
  }

  load(entry) {
    const link = list(this.document, "link").find(l => l.name === entry.link);
    const place = entry.pin !== undefined ? this.place(entry.pin) : link && middle(link, this.document);
    if (!place) return;
    const body = entry.link !== undefined ? this.body(entry.link) : this.bodyOf(entry.pin);
    if (entry.torque !== undefined) {
      this.put("elements", this.turn(at(body, place, 0, 0), 18, String(entry.torque).trim().startsWith("-") ? -1 : 1));
      return;
    }
    const [x, y] = (entry.force ?? []).map(value => parseFloat(value));
    if (!(Math.hypot(x, y) > 0)) return;
    const frame = at(body, place, Math.atan2(y, x), entry.frame === "body" ? 1 : 0);
    this.put("elements", [line(frame, offsets([[0, 0], [37, 0]]), "accent", 2.2), this.head(frame, [42, 0], [1, 0])]);
  }
}

/** The given centre of a link, or else the middle of its pins (m). */
export function middle(link, document) {
  if (Array.isArray(link.centre)) return link.centre.map(x => length(x, document));
  const places = (link.pins ?? []).map(pin => placeOf(document, pin)).filter(Boolean);
  return places.length ? [0, 1].map(k => places.reduce((sum, p) => sum + p[k], 0) / places.length) : null;
}
