// Dimensions on the drawing, as in one on paper: lengths of bars, lengths and angles by which pins are given, and where supports and
// lines of slides are. A click on one opens a field in its place.

import {bars, lengthOf, offsetOf, withLine, withPinNumber, withTypedBar} from "./dimensions.js";
import {groundOf, pinsOf, placeOf} from "./document.js";
import {angle, angleName, angleUnit, expressed, length, lengthUnit, readMeasure, tidy, usesNumbers, written} from "./units.js";
import {axisOf, placesOf} from "./pin_forms.js";
import {valueText} from "./values.js";
import {toPixels} from "./view.js";
import {make} from "./player/elements.js";

const AWAY = 22, FARTHER = 40;  // px from a bar to its dimension, and from supports to theirs
const LEVELS = [0, 18, 36, 54, 72], SHARES = [0.5, 0.35, 0.65];  // px: how much farther; and where on its line the text of a dimension may be
const GAP = 4, HEAD = 6, RADIUS = 34, SIZE = 11, LETTER = 3.2;  // px: before an extension line, of arrowheads, of an angle's arc, of its text, and half a letter
const ZERO = 1e-9;  // fraction of the drawing's extent: supports that are closer in a coordinate are level

const minus = (a, b) => [a[0] - b[0], a[1] - b[1]], plus = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1]];
const bySize = ([x, y]) => { const size = Math.hypot(x, y) || 1; return [x / size, y / size]; };
const rounded = x => tidy(+x.toPrecision(6));

/** The words of a number: as it is typed, and its value if it is an expression of named numbers. */
function wordsOf(written, value, document, unit = "") {
  return usesNumbers(written, document) ? `${written} = ${rounded(value)}${unit}` : `${rounded(value)}${unit}`;
}

/** A length between two places (m). */
const lengthMark = (document, key, from, to, typed, take) => {
  const value = Math.hypot(...minus(to, from)) / lengthUnit(document);
  return {key, kind: "line", from, to, words: wordsOf(typed, value, document), typed: typed === undefined ? String(rounded(value)) : valueText(typed), take};
};

/** The dimensions of a drawing: {key, kind, words, typed, take}; `take` returns the drawing in which a text takes the place of `typed`. */
export function marksOf(document) {
  const all = bars(document), found = all.map(link => lengthMark(document, `link ${link.name}`, ...link.pins.map(pin => placeOf(document, pin)), lengthOf(document, link)?.value,
    text => withTypedBar(document, link, text, "length")));
  const isBar = (a, b) => all.some(({pins}) => pins.includes(a) && pins.includes(b));
  for (const [name, value] of Object.entries(pinsOf(document))) {
    const at = placeOf(document, name);
    if (at && value && !Array.isArray(value)) found.push(...formMarks(document, name, value, at, isBar));
  }
  return [...found, ...supportMarks(document), ...lineMarks(document)];
}

/** The lengths and the angle by which a pin is given, but for those of bars. */
function* formMarks(document, name, value, at, isBar) {
  const from = [value.from].flat(), put = (keys, quantity) => text => withPinNumber(document, name, keys, text, quantity);
  for (const [k, anchor] of from.entries()) {
    const typed = Array.isArray(value.length) ? value.length[k] : value.length, start = placeOf(document, anchor);
    if (typed === undefined || !start || isBar(name, anchor) || value.to !== undefined) continue;
    yield lengthMark(document, `pin ${name} ${anchor}`, start, at, typed, put(Array.isArray(value.length) ? ["length", k] : ["length"], "length"));
  }
  if (value.angle === undefined) return;
  const axis = axisOf(value, placesOf(document)), by = angle(value.angle, document), start = placeOf(document, value.from);
  if (!axis || !start || !Number.isFinite(by)) return;
  yield {key: `angle ${name}`, kind: "arc", at: start, axis: Math.atan2(axis[1], axis[0]), by, words: wordsOf(value.angle, by / angleUnit(document), document, angleName(document)),
    typed: valueText(value.angle), take: put(["angle"], "angle")};
}

/** Where supports by coordinates are, seen from the first one. */
function* supportMarks(document) {
  const pins = groundOf(document).filter(name => Array.isArray(pinsOf(document)[name]) && placeOf(document, name)), [first, ...others] = pins, unit = lengthUnit(document);
  const origin = first && placeOf(document, first);
  for (const name of others) {
    const place = placeOf(document, name), size = Math.hypot(...minus(place, origin));
    for (const k of [0, 1]) {
      const away = place[k] - origin[k], typed = pinsOf(document)[name][k], corner = k ? [origin[0], place[1]] : [place[0], origin[1]];
      if (Math.abs(away) <= ZERO * size) continue;
      const put = text => {
        const read = readMeasure(text, "length", document), next = length(read, document);
        if (!Number.isFinite(next)) return {problem: `"${text}" is not a length: write 12 or 12 mm`};
        const side = next < 0 ? next : next * Math.sign(away), isPlain = origin[k] === 0 && usesNumbers(read, document);
        return withPinNumber(document, name, [k], isPlain ? text : String(tidy((origin[k] + side) / unit)), "length");
      };
      yield {...lengthMark(document, `support ${name} ${k}`, origin, corner, origin[k] === 0 && usesNumbers(typed, document) ? typed : undefined, put), ends: [origin, place], k};
    }
  }
}

/** The distances of the lines of slides from the first support. */
function* lineMarks(document) {
  const first = groundOf(document).find(name => placeOf(document, name)), origin = first && placeOf(document, first);
  for (const pin of origin ? Object.keys(pinsOf(document)) : []) {
    const found = offsetOf(document, pin, origin);
    if (!found || Math.abs(found.offset) <= ZERO * found.size) continue;
    yield lengthMark(document, `line ${found.name}`, origin, plus(origin, found.normal, found.offset), undefined, text => {
      const next = length(readMeasure(text, "length", document), document);
      return Number.isFinite(next) ? withLine(document, pin, origin, next < 0 ? next : next * Math.sign(found.offset)) : {problem: `"${text}" is not a length: write 12 or 12 mm`};
    });
  }
}

export class DimensionMarks {
  constructor(studio, element) {
    Object.assign(this, {studio, element, boxes: [], last: new Map()});
    this.input = make("input", {type: "text", "aria-label": "dimension", spellcheck: "false"});
    this.input.addEventListener("keydown", event => {
      if (event.key === "Enter") this.take();
      if (event.key === "Escape") this.close();
      event.stopPropagation();
    });
    this.input.addEventListener("blur", () => { if (!this.element.hidden) this.take(true); });
    element.append(this.input);
    element.hidden = true;
  }

  /** The dimension whose text is at a pixel; null if there is none. */
  at([x, y]) { return this.boxes.find(({box: [x0, y0, x1, y1]}) => x > x0 && x < x1 && y > y0 && y < y1)?.mark ?? null; }

  /** Ask for another value of a dimension, in its place. */
  open(mark) {
    const [x0, y0, x1, y1] = this.boxes.find(one => one.mark === mark).box;
    this.mark = mark;
    this.element.hidden = false;
    Object.assign(this.element.style, {left: `${(x0 + x1) / 2}px`, top: `${(y0 + y1) / 2}px`});
    this.input.value = mark.typed;
    this.input.size = Math.max(6, mark.typed.length + 2);
    this.input.focus();
    this.input.select();
  }

  close() {
    this.element.hidden = true;
    this.studio.parts.canvas.focus({preventScroll: true});
  }

  take(isLeft = false) {
    const text = this.input.value.trim(), {mark, studio} = this;
    if (!text || text === mark.typed) return isLeft ? void (this.element.hidden = true) : this.close();
    const found = mark.take(text);
    if (found.problem && !isLeft) return studio.say(found.problem, true);
    if (isLeft) this.element.hidden = true; else this.close();
    return studio.properties.take(found);
  }

  /** Draw the dimensions of the drawn position; their texts are kept clear of names. */
  draw(painter, theme, names) {
    const {studio} = this, {document} = studio;
    this.boxes = [];
    if (!studio.show.dimensions || studio.isMoved || studio.motion.posed) return;
    if (this.known !== document) Object.assign(this, {known: document, marks: marksOf(document)});
    const places = Object.values(placesOf(document)).map(place => toPixels(studio.view, place));
    const middle = [0, 1].map(k => places.reduce((sum, place) => sum + place[k], 0) / (places.length || 1));
    for (const mark of this.marks) {
      const drawn = mark.kind === "arc" ? this.arcs(mark) : this.lines(mark, middle);
      if (drawn.length) this.put(mark, drawn, painter, theme, names);
    }
  }

  /** Draw the first of some forms of a dimension whose text covers nothing, or else the one whose text covers least. */
  put(mark, drawn, painter, theme, names) {
    painter.context.font = `500 ${SIZE}px system-ui`;
    const wide = painter.context.measureText(mark.words).width / 2 + 3, high = 0.7 * SIZE;
    const boxAt = ([x, y]) => [x - wide, y - high, x + wide, y + high], shared = (a, b) => [0, 1].reduce((area, k) => area * Math.max(0, Math.min(a[k + 2], b[k + 2]) - Math.max(a[k], b[k])), 1);
    const covered = ({at}) => names.boxes.reduce((sum, box) => sum + shared(boxAt(at), box), 0), last = this.last.get(mark.key) ?? 0;
    const order = [last, ...drawn.keys()].filter(k => k < drawn.length), costs = order.map(k => covered(drawn[k])), best = order[costs.indexOf(Math.min(...costs))];
    this.last.set(mark.key, best);
    const {at, lines, heads, arc} = drawn[best], box = boxAt(at), [x0, y0, x1, y1] = box, c = painter.context;
    for (const {points, width, colour} of lines) painter.line(points, width, theme[colour]);
    if (arc) painter.circle(arc.centre, arc.radius, {stroke: theme.soft, width: 0.9, from: Math.min(-arc.from, -arc.to), to: Math.max(-arc.from, -arc.to)});
    for (const corners of heads) painter.line(corners, 0, "", {closed: true, fill: theme.soft});
    c.fillStyle = theme.back;
    c.globalAlpha = 0.85;
    c.fillRect(x0, y0, x1 - x0, y1 - y0);
    c.globalAlpha = 1;
    this.boxes.push({mark, box});
    names.boxes.push(box);
    painter.text(mark.words, at, theme.soft, {align: "center", size: SIZE, weight: 500, halo: false});
  }

  /** The forms of a length: on the side away from the drawing's middle first, then on the other one, then farther away. */
  lines(mark, middle) {
    const px = place => toPixels(this.studio.view, place), isSupport = mark.ends !== undefined, [a, b] = [px(mark.from), px(mark.to)];
    if (Math.hypot(...minus(b, a)) < 2 * HEAD) return [];
    if (isSupport) {  // below or to the left of both, parallel to an axis
      const along = 1 - mark.k, sign = mark.k ? -1 : 1, ends = mark.ends.map(px), edge = Math.max(...ends.map(p => p[along] * sign));
      return LEVELS.map(level => this.lifted(ends, ends.map(p => p.with(along, sign * (edge + FARTHER + level)))));
    }
    const normal = bySize([-(b[1] - a[1]), b[0] - a[0]]), centre = [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
    const outside = normal[0] * (centre[0] - middle[0]) + normal[1] * (centre[1] - middle[1]) < 0 ? -1 : 1;
    return LEVELS.flatMap(level => [outside, -outside].flatMap(side => SHARES.map(share => this.lifted([a, b], [a, b].map(p => plus(p, normal, side * (AWAY + level))), share))));
  }

  /** A line with arrows between `to`, lifted from `from` by extension lines, and where its text is. */
  lifted(from, to, share = 0.5) {
    const [a, b] = to, way = bySize(minus(b, a)), isLong = Math.hypot(...minus(b, a)) > 4 * HEAD;
    const extensions = from.map((p, k) => ({points: [plus(p, bySize(minus(to[k], p)), GAP), plus(to[k], bySize(minus(to[k], p)), GAP)], width: 0.8, colour: "line"}));
    return {at: plus(a, minus(b, a), share), lines: [...extensions, {points: to, width: 0.9, colour: "soft"}], heads: isLong ? [head(a, way), head(b, way.map(x => -x))] : []};
  }

  /** The forms of an angle, from its axis to its arm: nearer to the pin first. */
  arcs({at, axis, by, words}) {
    const centre = toPixels(this.studio.view, at);
    return LEVELS.flatMap(level => SHARES.map(share => {
      const radius = RADIUS + level, on = (turn, far = radius) => [centre[0] + far * Math.cos(turn), centre[1] - far * Math.sin(turn)], end = axis + by;
      const back = [Math.sin(end), Math.cos(end)].map(x => Math.sign(by || 1) * x), isOpen = Math.abs(by) * radius > 2 * HEAD;
      const turn = axis + by * share, room = 6 + LETTER * words.length * Math.abs(Math.cos(turn)) + SIZE / 2 * Math.abs(Math.sin(turn));
      return {at: on(turn, radius + room), lines: [{points: [centre, on(axis, radius + 8)], width: 0.8, colour: "line"}], heads: isOpen ? [head(on(end), back)] : [],
        arc: {centre, radius, from: axis, to: end}};
    }));
  }
}

/** An arrowhead with its tip at a pixel; `back` is the direction in which it opens. */
function head(tip, back) {
  const foot = plus(tip, back, HEAD), side = [-back[1], back[0]];
  return [tip, plus(foot, side, HEAD / 3), plus(foot, side, -HEAD / 3)];
}
