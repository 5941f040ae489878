// The symbols of marks (udkjax/show/player/marks.py), a method for each kind.

import {angleOf, clamp} from "./motion.js";
import {Painter} from "./painter.js";

/** Draws marks: each by the method of its kind. */
export class MarkPainter extends Painter {
  draw(marks) {
    for (const mark of marks) this[mark.kind]?.(mark);
  }

  link({body, points, closed}) {
    const corners = points.map(([x, y]) => this.anchor([body, x, y]));
    const edge = this.colour(body), fill = this.fillOf(body);
    this.line(corners, 11, edge, {closed, fill: closed ? edge : null});
    this.line(corners, 8, fill, {closed, fill: closed ? fill : null});
  }

  disc(mark) {
    const radius = Math.max(this.view.scale * mark.radius, 7 * this.pt);
    this.circle(this.at(mark), radius, {fill: this.fillOf(mark.body), stroke: this.colour(mark.body)});
    this.centre(mark);
  }

  /** The sign of a centre of mass: a circle in quarters, which shows how a body turns. */
  centre(mark) {
    const r = 4.5 * this.pt, {ink, back} = this.theme;
    this.inFrame(this.at(mark), angleOf(this.pose, mark.body), c => {
      this.circle([0, 0], r, {fill: back, stroke: ink, width: 1});
      c.fillStyle = ink;
      for (const start of [0, Math.PI]) { c.beginPath(); c.moveTo(0, 0); c.arc(0, 0, r, start, start + Math.PI / 2); c.fill(); }
    });
  }

  wheel(mark) {
    const radius = this.view.scale * mark.radius, pt = this.pt, edge = this.colour(mark.body);
    const depth = Math.min(4 * pt, 0.12 * radius), teeth = clamp(Math.round(2 * Math.PI * radius / (9 * pt) / 4) * 4, 12, 96);
    this.inFrame(this.at(mark), angleOf(this.pose, mark.body), c => {
      const rim = [];
      for (let k = 0; k < teeth; k++) {
        for (const [part, r] of [[0, -1], [0.25, -1], [0.35, 1], [0.65, 1], [0.75, -1]]) {
          const angle = 2 * Math.PI * (k + part) / teeth, reach = radius + r * depth / 2;
          rim.push([reach * Math.cos(angle), reach * Math.sin(angle)]);
        }
      }
      if (mark.internal) {
        this.circle([0, 0], radius + depth + 5 * pt, {fill: this.fillOf(mark.body), stroke: edge});
        this.line(rim, 1.3, edge, {closed: true, fill: this.theme.back});
        return;
      }
      this.line(rim, 1.3, edge, {closed: true, fill: this.fillOf(mark.body)});
      c.globalAlpha = 0.75;
      for (let k = 0; k < 3; k++) {
        const angle = 2 * Math.PI * k / 3, inner = Math.min(9 * pt, 0.3 * radius), outer = 0.8 * radius;
        this.line([[inner * Math.cos(angle), inner * Math.sin(angle)], [outer * Math.cos(angle), outer * Math.sin(angle)]], 2.2, edge);
      }
    });
  }

  outline({body, points}) {
    this.line(points.map(([x, y]) => this.anchor([body, x, y])), 1.6, this.colour(body), {closed: true, fill: this.fillOf(body)});
  }

  /** The ends of a rail in its frame (px), and its place and angle. */
  railFrame({body, at, axis, span}, draw) {
    const [a, b] = span.map(s => s * this.view.scale);
    this.inFrame(this.anchor([body, ...at]), angleOf(this.pose, body) + axis, c => draw(c, a, b));
  }

  rail(mark) {
    const pt = this.pt, {soft, back} = this.theme;
    this.railFrame(mark, (c, a, b) => {
      if (mark.slot) {
        c.beginPath();
        c.roundRect(a, -6.5 * pt, b - a, 13 * pt, 6.5 * pt);
        c.fillStyle = back;
        c.fill();
        c.lineWidth = 1.3 * pt;
        c.strokeStyle = this.colour(mark.body);
        c.stroke();
        return;
      }
      if (mark.body >= 0) { this.line([[a, 0], [b, 0]], 3, this.colour(mark.body)); return; }
      this.line([[a, 9 * pt], [b, 9 * pt]], 1.5, soft);
      this.hatch(a, b, 9 * pt);
    });
  }

  rack(mark) {
    const pt = this.pt, colour = this.colour(mark.body), step = 9 * pt;
    this.railFrame(mark, (c, a, b) => {
      const teeth = [];
      for (let x = a; x < b; x += step) teeth.push([x, 2 * pt], [x + 0.3 * step, -2 * pt], [x + 0.7 * step, -2 * pt], [x + step, 2 * pt]);
      this.line(teeth, 1.4, colour);
      this.line([[a, 7 * pt], [b, 7 * pt]], 1.4, colour);
      if (mark.body < 0) this.hatch(a, b, 7 * pt);
    });
  }

  block(mark) {
    const pt = this.pt;
    this.inFrame(this.at(mark), angleOf(this.pose, mark.body) + mark.axis, c => {
      c.beginPath();
      c.roundRect(-15 * pt, -9 * pt, 30 * pt, 18 * pt, 3 * pt);
      c.fillStyle = this.fillOf(mark.body);
      c.fill();
      c.lineWidth = 1.5 * pt;
      c.strokeStyle = this.colour(mark.body);
      c.stroke();
    });
  }

  support(mark) {
    const [x, y] = this.at(mark), pt = this.pt, {back, soft} = this.theme, foot = y + 17 * pt;
    this.line([[x, y], [x - 10 * pt, foot], [x + 10 * pt, foot]], 1.4, soft, {closed: true, fill: back});
    this.line([[x - 15 * pt, foot], [x + 15 * pt, foot]], 1.4, soft);
    this.hatch(x - 15 * pt, x + 15 * pt, foot);
  }

  pin(mark) {
    this.circle(this.at(mark), 4.2 * this.pt, {fill: this.theme.back, stroke: this.theme.ink, width: 1.7});
  }

  roller(mark) {
    this.circle(this.at(mark), 4.8 * this.pt, {fill: this.fillOf(mark.body), stroke: this.theme.ink, width: 1.7});
    this.circle(this.at(mark), 1.2 * this.pt, {fill: this.theme.ink});
  }

  weld(mark) {
    const r = 4.5 * this.pt;
    this.inFrame(this.at(mark), angleOf(this.pose, mark.body), c => {
      c.fillStyle = this.theme.ink;
      c.fillRect(-r, -r, 2 * r, 2 * r);
    });
  }

  rod({a, b}) {
    this.line([this.anchor(a), this.anchor(b)], 2.4, this.theme.ink);
  }

  /** Draw between two anchors, in a frame along them: draw(length). */
  between({a, b}, draw) {
    const [x0, y0] = this.anchor(a), [x1, y1] = this.anchor(b);
    this.inFrame([x0, y0], -Math.atan2(y1 - y0, x1 - x0), () => draw(Math.hypot(x1 - x0, y1 - y0)));
    for (const end of [a, b]) this.circle(this.anchor(end), 2.6 * this.pt, {fill: this.theme.ink});
  }

  spring(mark) {
    const pt = this.pt, {ink} = this.theme;
    this.between(mark, length => {
      const end = Math.min(10 * pt, 0.15 * length), coils = clamp(Math.round(length / (11 * pt)), 6, 24), line = [[0, 0], [end, 0]];
      const high = (mark.damper ? 5 : 7) * pt, shift = mark.damper ? -5 * pt : 0;
      if (mark.damper) line.push([end, shift]);
      for (let k = 0; k < 2 * coils; k++) line.push([end + (length - 2 * end) * (k + 0.5) / (2 * coils), shift + (k % 2 ? high : -high)]);
      if (mark.damper) line.push([length - end, shift]);
      line.push([length - end, 0], [length, 0]);
      this.line(line, 1.5, ink);
      if (mark.damper) {
        const y = 9 * pt, box = 0.38 * length, right = 0.62 * length, piston = 0.5 * length;
        this.line([[end, 0], [end, y], [piston, y]], 1.5, ink);
        this.line([[piston, y - 3 * pt], [piston, y + 3 * pt]], 1.8, ink);
        this.line([[box, y - 5 * pt], [right, y - 5 * pt], [right, y + 5 * pt], [box, y + 5 * pt]], 1.5, ink);
        this.line([[right, y], [length - end, y], [length - end, 0]], 1.5, ink);
      }
    });
  }

  spiral(mark) {
    const line = [];
    for (let k = 0; k <= 60; k++) {
      const r = (5 + 8 * k / 60) * this.pt, angle = 0.25 * k;
      line.push([r * Math.cos(angle), r * Math.sin(angle)]);
    }
    this.inFrame(this.at(mark), angleOf(this.pose, mark.body), () => this.line(line, 1.3, this.theme.ink));
  }

  piston(mark) {
    const {ink, back} = this.theme;
    this.between(mark, length => {
      this.line([[0, 0], [length, 0]], 3, ink);
      this.line([[0, 0], [0.55 * length, 0]], 9, ink);
      this.line([[0, 0], [0.55 * length, 0]], 6, back);
    });
  }

  motor(mark) {
    this.turn(this.at(mark), 11, 1, this.theme.accent);
  }

  friction(mark) {
    const place = this.at(mark), pt = this.pt;
    this.circle(place, 8 * pt, {stroke: this.theme.soft, width: 1.2});
    for (let k = 0; k < 8; k++) {
      const angle = Math.PI * k / 4, c = Math.cos(angle), s = Math.sin(angle);
      this.line([[place[0] + 8 * pt * c, place[1] + 8 * pt * s], [place[0] + 11 * pt * c, place[1] + 11 * pt * s]], 1.2, this.theme.soft);
    }
  }

  force(mark) {
    const angle = Math.atan2(mark.vector[1], mark.vector[0]) + (mark.turns ? angleOf(this.pose, mark.body) : 0);
    const [x, y] = this.at(mark), length = 42 * this.pt;
    this.arrow([x, y], [x + length * Math.cos(angle), y - length * Math.sin(angle)], this.theme.accent);
  }

  torque(mark) {
    this.turn(this.at(mark), 16, mark.sign, this.theme.accent);
  }

  /** A round arrow: sign 1 is anticlockwise. */
  turn(place, radius, sign, colour) {
    const c = this.context, pt = this.pt, r = radius * pt;
    c.save();
    c.translate(...place);
    c.scale(1, -sign);
    this.circle([0, 0], r, {stroke: colour, width: 1.8, from: -0.5, to: 3.5});
    const tip = 3.5, x = r * Math.cos(tip), y = r * Math.sin(tip), dx = -Math.sin(tip), dy = Math.cos(tip);
    this.head([x + 4 * pt * dx, y + 4 * pt * dy], Math.atan2(dy, dx), colour);
    c.restore();
  }
}
