// Symbols (udkjax/show/player/marks/symbols.py): lines and circles in frames that move with bodies.

import {angleOf, clamp} from "./motion.js";
import {Painter, mix} from "./painter.js";

/** True if a point is inside a closed line, or closer to a line than `reach`. */
export function isNear([x, y], corners, closed, reach) {
  const ends = closed ? [...corners, corners[0]] : corners;
  let inside = false;
  for (let k = 1; k < ends.length; k++) {
    const [[ax, ay], [bx, by]] = [ends[k - 1], ends[k]], dx = bx - ax, dy = by - ay;
    const s = clamp(((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy || 1), 0, 1);
    if (Math.hypot(x - ax - s * dx, y - ay - s * dy) <= reach) return true;
    if ((ay > y) !== (by > y) && x < ax + dx * (y - ay) / dy) inside = !inside;
  }
  return inside && Boolean(closed);
}

/** Draws symbols at a pose. */
export class SymbolPainter extends Painter {
  draw(symbols) {
    for (const symbol of symbols) {
      const {centre, size, corners} = this.outline(symbol), fill = this.tone(symbol.fill), stroke = this.tone(symbol.stroke);
      if (centre) this.circle(centre, size, {fill, stroke, width: symbol.width});
      else this.line(corners, symbol.width, stroke, {closed: symbol.closed, fill});
    }
  }

  /** The outline of a symbol (px): the centre and the radius of a circle, or the corners of a line. */
  outline({frame, radius, points}) {
    const [[x0, y0], cos, sin, scale] = this.axes(frame), {pt} = this;
    if (radius) {
      const [metres, units, least] = radius;
      return {centre: [x0, y0], size: Math.max(this.view.scale * metres + pt * units, pt * least)};
    }
    const corners = points.map(([x, y, px = 0, py = 0]) => {
      const along = scale * x + pt * px, up = scale * y + pt * py;
      return [x0 + cos * along - sin * up, y0 - sin * along - cos * up];
    });
    return {corners};
  }

  /** True if a symbol is at a pixel, or closer to it than `reach`. */
  holds(symbol, x, y, reach) {
    const {centre, size, corners} = this.outline(symbol);
    if (centre) return Math.hypot(x - centre[0], y - centre[1]) <= size + reach;
    return isNear([x, y], corners, symbol.closed, symbol.width * this.pt / 2 + reach);
  }

  /** The origin of a frame (px), the cosine and sine of the angle of its x axis, and its unit of length (px). */
  axes(frame) {
    if (frame.length === 2) {
      const [[x0, y0], [x1, y1]] = frame.map(anchor => this.anchor(anchor)), length = Math.hypot(x1 - x0, y1 - y0);
      return [[x0, y0], (x1 - x0) / (length || 1), (y0 - y1) / (length || 1), length];
    }
    const [body, x, y, angle, turns] = frame, turned = angle + (turns ? angleOf(this.pose, body) : 0);
    return [this.anchor([body, x, y]), Math.cos(turned), Math.sin(turned), this.view.scale];
  }

  /** A colour by its name. */
  tone(name) {
    const [kind, number] = name.split(":"), edge = number && this.colour(+number);
    if (!number) return this.theme[kind] ?? null;
    const tint = mix(edge, this.theme.back, this.theme.tint);
    return {edge, tint, spoke: mix(edge, tint, 0.25)}[kind];
  }
}
