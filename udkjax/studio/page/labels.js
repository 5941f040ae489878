// Names in the drawing: each beside what it names, where no other name and no pin is. One that has a place keeps it while it is free.

const SIZE = 12, HIGH = 14;  // px
const PIN = 7;  // px around the middle of a pin, where no name stands
const BESIDE = 14;  // px from a bar to its name
const PLACES = [[9, -12, "left"], [9, 14, "left"], [-9, -12, "right"], [-9, 14, "right"]];  // around a pin (px)

export class Labels {
  constructor() { this.last = new Map(); }

  /** Begin a picture, in which pins are at `places` and signs stand at some (px). */
  begin(painter, places, signs) {
    this.painter = painter;
    this.boxes = [...[...places].map(([x, y]) => [x - PIN, y - PIN, x + PIN, y + PIN]), ...signs.map(([x, y]) => [x, y - HIGH / 2, x + HIGH, y + HIGH / 2])];
  }

  /** Write words at the first free one of some places [x, y, align]; `key` names them. */
  put(key, words, places, colour, weight) {
    const {painter, last, boxes} = this;
    painter.context.font = `${weight} ${SIZE}px system-ui`;
    const wide = painter.context.measureText(words).width;
    const boxOf = ([x, y, align]) => { const left = x - {left: 0, center: wide / 2, right: wide}[align]; return [left, y - HIGH / 2, left + wide, y + HIGH / 2]; };
    const isFree = k => { const a = boxOf(places[k]); return boxes.every(b => a[2] < b[0] || b[2] < a[0] || a[3] < b[1] || b[3] < a[1]); };
    const before = Math.min(last.get(key) ?? 0, places.length - 1), order = [before, ...places.keys()], found = order.find(isFree) ?? before;
    last.set(key, found);
    boxes.push(boxOf(places[found]));
    const [x, y, align] = places[found];
    painter.text(words, [x, y], colour, {size: SIZE, weight, align});
  }
}

export const aroundPin = ([x, y]) => PLACES.map(([dx, dy, align]) => [x + dx, y + dy, align]);

/** Beside a bar between two places (px), at its middle or nearer to an end, below it first. */
export function besideBar([ax, ay], [bx, by]) {
  const length = Math.hypot(bx - ax, by - ay) || 1, turn = Math.sign(bx - ax) || 1;
  const [nx, ny] = [-turn * (by - ay) / length, turn * (bx - ax) / length], found = [];
  for (const side of [1, -1]) {
    for (const s of [0.5, 0.3, 0.7]) {
      const x = side * nx, align = Math.abs(nx) < 0.4 ? "center" : x > 0 ? "left" : "right";
      found.push([ax + s * (bx - ax) + BESIDE * x, ay + s * (by - ay) + side * (BESIDE + 2) * ny, align]);
    }
  }
  return found;
}

/** Within a plate or a disc, at its middle (px) or a line below or above. */
export const within = ([x, y], isDisc) => (isDisc ? [17, -17, 31] : [0, 17, -17]).map(dy => [x, y + dy, "center"]);
