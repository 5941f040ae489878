// Symbols (udkjax/show/player/symbols.py): lines and circles in frames that move with bodies.

import {angleOf} from "./motion.js";
import {Painter, mix} from "./painter.js";

/** Draws symbols at a pose. */
export class SymbolPainter extends Painter {
  draw(symbols) {
    for (const {frame, radius, points, closed, width, ...look} of symbols) {
      const [[x0, y0], cos, sin, scale] = this.axes(frame), fill = this.tone(look.fill), stroke = this.tone(look.stroke), {pt} = this;
      if (radius) {
        const [metres, units, least] = radius;
        this.circle([x0, y0], Math.max(this.view.scale * metres + pt * units, pt * least), {fill, stroke, width});
        continue;
      }
      const corners = points.map(([x, y, px = 0, py = 0]) => {
        const along = scale * x + pt * px, up = scale * y + pt * py;
        return [x0 + cos * along - sin * up, y0 - sin * along - cos * up];
      });
      this.line(corners, width, stroke, {closed, fill});
    }
  }

  /** The origin of a frame (px), the cosine and sine of the angle of its x axis, and the pixels of its unit of length. */
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
