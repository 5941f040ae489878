// Names in a picture: each next to its element, where it covers no other name and no pin. A name keeps its place while that is free.

const SIZE = 12, HIGH = 14;  // px
const PIN = 7;  // px around the centre of a pin that names keep clear
const BESIDE = 14;  // px from a bar to its name
const ROUNDING = 1e-6;  // px2
const BOLD = 700;  // font weight of signs, and of names of selected elements
const PLACES = [[9, -12, "left"], [9, 14, "left"], [-9, -12, "right"], [-9, 14, "right"], [0, -20, "center"], [0, 22, "center"]];  // around a pin (px)

export class Labels {
  constructor() { this.last = new Map(); }

  /** Begin a picture, in which pins are at `places` (px). */
  begin(painter, places) {
    this.painter = painter;
    const {clientWidth, clientHeight} = painter.context.canvas;
    this.whole = [0, 0, clientWidth, clientHeight];
    this.unit = Math.max(1, painter.pt);
    this.boxes = Array.from(places, ([x, y]) => [x - PIN, y - PIN, x + PIN, y + PIN]);
  }

  /** Write words at the first free one of several places [x, y, align], or else where they cover least; `key` identifies them. A
   *  sign is never covered: a name without another place is left out, unless it is bold. */
  put(key, words, places, colour, weight, isSign = false) {
    const {painter, last, boxes, unit, whole} = this, high = HIGH * unit;
    painter.context.font = `${weight} ${SIZE * unit}px system-ui`;
    const wide = painter.context.measureText(words).width;
    const boxOf = ([x, y, align]) => { const left = x - {left: 0, center: wide / 2, right: wide}[align]; return [left, y - high / 2, left + wide, y + high / 2]; };
    const shared = (a, b) => [0, 1].reduce((area, k) => area * Math.max(0, Math.min(a[k + 2], b[k + 2]) - Math.max(a[k], b[k])), 1);
    const cost = (area, sign) => (sign && area > ROUNDING ? Infinity : area);
    const covered = k => { const box = boxOf(places[k]); return boxes.reduce((sum, b) => sum + cost(shared(box, b), b.isSign), wide * high - shared(box, whole)); };
    const before = Math.min(last.get(key) ?? 0, places.length - 1);
    let found = before, least = covered(before);
    for (let k = 0; k < places.length && least > ROUNDING; k++) {
      const now = covered(k);
      if (now < least) [found, least] = [k, now];
    }
    last.set(key, found);
    if (least === Infinity && weight < BOLD) return;
    boxes.push(Object.assign(boxOf(places[found]), {isSign}));
    const [x, y, align] = places[found];
    painter.text(words, [x, y], colour, {size: SIZE, weight, align});
  }
}

export const aroundPin = ([x, y], unit = 1) => PLACES.map(([dx, dy, align]) => [x + unit * dx, y + unit * dy, align]);

/** Places beside a bar between two pixels: at its middle or nearer to an end, below it first, then farther away. */
export function besideBar([ax, ay], [bx, by]) {
  const length = Math.hypot(bx - ax, by - ay) || 1, turn = Math.sign(bx - ax) || 1;
  const [nx, ny] = [-turn * (by - ay) / length, turn * (bx - ax) / length], found = [];
  for (const away of [1, 2.2]) {
    for (const side of [1, -1]) {
      for (const s of [0.5, 0.3, 0.7]) {
        const x = side * nx, align = Math.abs(nx) < 0.4 ? "center" : x > 0 ? "left" : "right";
        found.push([ax + s * (bx - ax) + away * BESIDE * x, ay + s * (by - ay) + away * side * (BESIDE + 2) * ny, align]);
      }
    }
  }
  return found;
}

/** Places within a plate or a disc: at its middle (px), or some lines below or above. */
export const within = ([x, y], isDisc) => (isDisc ? [17, -17, 31] : [0, 17, -17]).map(dy => [x, y + dy, "center"]);

/** Places at and around a pixel of a body. */
export function around([x, y], unit) {
  return [[0, 0], [0, 17], [0, -17], [34, 0], [-34, 0], [0, 34], [0, -34], [44, 17], [-44, 17], [44, -17], [-44, -17], [0, 51], [0, -51]]
    .map(([dx, dy]) => [x + unit * dx, y + unit * dy, "center"]);
}
