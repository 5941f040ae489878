// The drawing on its canvas: grid, picture, paths, symbols, marks of selected and redundant elements, names, and the current gesture.

import {groundOf, list, members, nameOf, pinsOf, placeOf} from "./document.js";
import {middle, symbolsOf} from "./drawn_symbols.js";
import {carry} from "./motions.js";
import {linkShape} from "./shapes.js";
import {Labels, aroundPin, besideBar, within} from "./player/labels.js";
import {THEMES, contextOf} from "./player/painter.js";
import {SymbolPainter} from "./player/symbols.js";
import {angleUnit, lengthUnit, shown} from "./units.js";
import {toPixels} from "./view.js";

const HALO = 7;  // px around a selected element
const LABEL = 12;  // px
const SIGN_PLACES = [[13, 11, "left"], [13, -11, "left"], [-13, 11, "right"], [-13, -11, "right"]];  // px: offsets of the letter of a mark

export class DrawingCanvas {
  constructor(element) {
    Object.assign(this, {element, places: new Map(), outlines: [], symbols: [], drawn: [], names: new Labels()});
  }

  get width() { return this.element.clientWidth; }
  get height() { return this.element.clientHeight; }

  /** The link that carries a pin, or -1 for the ground. */
  carrier(document, pin) {
    if (this.carriers?.document !== document) {
      const found = new Map();
      list(document, "link").forEach((link, k) => { for (const name of link.pins ?? []) if (!found.has(name)) found.set(name, k); });
      for (const name of groundOf(document)) found.set(name, -1);
      this.carriers = {document, found};
    }
    return this.carriers.found.get(pin) ?? -1;
  }

  /** Positions (px) of all pins but those in `except`. */
  placesOf(document, except = []) {
    const {view, motions} = this.studio, found = new Map();
    for (const name of Object.keys(pinsOf(document))) {
      const place = placeOf(document, name);
      if (place && !except.includes(name)) found.set(name, toPixels(view, carry(motions, this.carrier(document, name), place)));
    }
    return found;
  }

  draw(studio) {
    this.studio = studio;
    const {document, view, motions} = studio, {width, height} = this;
    if (!width || !height) return;
    const theme = THEMES[studio.theme], painter = new SymbolPainter(contextOf(this.element).context, view, theme, 1, motions);
    this.painter = painter;
    if (studio.picture) this.picture(studio.picture, view);
    if (studio.show.grid) studio.gridStep = painter.grid(width, height);
    const now = [document, view.scale, studio.paths];
    if (now.some((x, k) => x !== this.drawn[k])) {
      this.symbols = symbolsOf(document, 1 / view.scale, studio.paths);
      this.drawn = now;
    }
    this.paths(studio, painter);
    if (studio.wanted.points) painter.line(studio.wanted.points.map(p => toPixels(view, p)), 2.4, theme.accent, {dash: [7, 5]});
    this.outlines = this.symbols.map(symbol => this.outline(symbol, painter));
    this.halos(studio, painter, theme);
    painter.draw(this.symbols);
    studio.answers.gaps.draw(painter);
    studio.vectors.draw(painter, theme);
    this.places = this.placesOf(document);
    this.names.begin(painter, this.places.values());
    const {offsetLeft: left, offsetTop: top, offsetWidth: wide, offsetHeight: high} = studio.parts.options;
    this.names.boxes.push([left, top, left + wide, top + high]);
    studio.dimensions.draw(painter, theme, this.names);
    this.marks(studio, painter, theme);
    this.labels(studio, painter, theme);
    this.preview(studio, painter, theme);
    if (studio.show.grid) painter.bar(studio.gridStep, height);
  }

  picture({image, x, y, width: wide, opacity}, view) {
    const c = this.painter.context, [left, top] = toPixels(view, [x, y]), across = wide * view.scale;
    c.globalAlpha = opacity;
    c.drawImage(image, left, top - across * image.height / image.width, across, across * image.height / image.width);
    c.globalAlpha = 1;
  }

  /** The outline of a symbol in pixels, for picking. */
  outline(symbol, painter) {
    const {centre, size, corners} = painter.outline(symbol), {of, closed, width} = symbol;
    return {of, closed, width, points: corners ?? [centre], radius: size};
  }

  paths({paths, show}, painter) {
    if (!show.paths) return;
    const c = painter.context;
    for (const {line, link} of paths) {
      c.beginPath();
      for (let k = 0; k < line.length; k += 2) {
        const [x, y] = painter.px([line[k], line[k + 1]]);
        if (k) c.lineTo(x, y); else c.moveTo(x, y);
      }
      c.globalAlpha = 0.5;
      c.lineWidth = 1.2;
      c.strokeStyle = painter.colour(link);
      c.stroke();
      c.globalAlpha = 1;
    }
  }

  halos({selection, hovered}, painter, theme) {
    for (const [items, alpha] of [[hovered ? [hovered] : [], 0.22], [selection, 0.5]]) {
      painter.context.globalAlpha = alpha;
      for (const {of, points, radius, closed, width} of this.outlines) {
        if (of.kind === "pin" && radius === undefined) continue;  // the support of the pin
        if (!items.some(item => item.kind === of.kind && item.index === of.index && item.name === of.name)) continue;
        if (radius !== undefined) painter.circle(points[0], radius + HALO / 2, {stroke: theme.accent, width: HALO});
        else painter.line(points, width + HALO, theme.accent, {closed});
      }
      painter.context.globalAlpha = 1;
    }
  }

  /** Marks of the findings: pins with redundant constraints, each with a letter. */
  marks({marked, preview}, painter, theme) {
    for (const [name, {sign, strong}] of marked) {
      const place = this.places.get(name);
      if (!place) continue;
      painter.circle(place, 10, {stroke: theme.force, width: strong ? 2.6 : 1.3});
      this.names.put(`sign ${name}`, sign, SIGN_PLACES.map(([x, y, align]) => [place[0] + x, place[1] + y, align]), theme.force, 700, true);
    }
    if (preview?.onto) {
      const place = this.places.get(preview.onto);
      if (place) painter.circle(place, 13, {stroke: theme.accent, width: 2.4});
    }
  }

  labels({document, show, selection, motions}, painter, theme) {
    const isChosen = (kind, name, index) => selection.some(item => item.kind === kind && item.name === name && item.index === index);
    const {names} = this;
    for (const [name, place] of this.places) {
      const chosen = isChosen("pin", name, undefined);
      if (show.names || chosen) names.put(`pin ${name}`, name, aroundPin(place), theme.ink, chosen ? 700 : 400);
    }
    list(document, "link").forEach((link, k) => {
      const chosen = isChosen("link", undefined, k), places = this.namePlaces(link, k, document, painter, motions);
      if (places && (chosen || (show.names && link.pins?.length > 1))) names.put(`link ${k}`, link.name ?? "", places, painter.textColour(k), chosen ? 700 : 500);
    });
    for (const section of ["motor", "spring", "damper", "load", "gear", "cam"]) {
      list(document, section).forEach((entry, k) => {
        const outline = isChosen(section, undefined, k) && this.outlines.find(({of}) => of.kind === section && of.index === k);
        if (outline) names.put(`${section} ${k}`, nameOf(document, section, k), aroundPin([outline.points[0][0] + 5, outline.points[0][1] - 6]), theme.accent, 700);
      });
    }
  }

  /** Candidate positions of a link's name: within a plate, or beside a bar. */
  namePlaces(link, k, document, painter, motions) {
    const pixel = place => toPixels(painter.view, carry(motions, k, place)), shape = linkShape(document, link), centre = middle(link, document);
    if (!shape || !centre) return null;
    return shape.kind === "line" ? besideBar(pixel(shape.points[0]), pixel(shape.points.at(-1))) : within(pixel(centre), shape.kind === "disc");
  }

  preview({preview, document, view, hand}, painter, theme) {
    const at = target => (target.pin !== null && this.places.get(target.pin)) || toPixels(view, target.place);
    if (hand) {
      const place = toPixels(view, hand.to);
      painter.line([toPixels(view, hand.at), place], 1.5, theme.accent, {dash: [4, 4]});
      painter.circle(place, 5, {stroke: theme.accent, width: 2});
    }
    if (!preview) return;
    if (preview.area) {
      const [[x0, y0], [x1, y1]] = preview.area;
      painter.line([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], 1.2, theme.accent, {closed: true, dash: [4, 3]});
    }
    if (preview.corners) painter.line(preview.corners.map(at), 2, theme.accent, {dash: [6, 4]});
    for (const target of preview.corners ?? []) painter.circle(at(target), 5, {stroke: theme.accent, width: 2});
    if (preview.from) {
      const [a, b] = [at(preview.from), at(preview.to)];
      painter.line([a, b], 2.4, theme.accent, {dash: [6, 4]});
      for (const place of [a, b]) painter.circle(place, 5, {fill: theme.back, stroke: theme.accent, width: 2});
      const [dx, dy] = [0, 1].map(k => preview.to.place[k] - preview.from.place[k]), away = Math.hypot(dx, dy);
      if (away > 0) {
        const words = `${shown(away / lengthUnit(document), document.units?.length ?? "m")}  ${shown(Math.atan2(dy, dx) / angleUnit(document), document.units?.angle ?? "rad")}`;
        painter.text(words, [(a[0] + b[0]) / 2 + 10, (a[1] + b[1]) / 2 - 14], theme.accent, {size: LABEL, weight: 600});
      }
    }
    if (preview.to && members(document, preview.to.pin ?? "").length) painter.circle(at(preview.to), 12, {stroke: theme.accent, width: 2});
  }
}
