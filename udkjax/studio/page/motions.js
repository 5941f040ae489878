// Motions of links: maps p -> t + R p of the plane, which bring a place of the drawing to where a link carries it. Each is three
// numbers: the translation t, and the angle of R.

/** The motions that bring bodies from the frames `drawn` (x, y, angle) to the frames `q`; `order` has the body of each link. */
export function motionsOf(q, drawn, order) {
  const found = new Float64Array(3 * order.length);
  order.forEach((body, k) => {
    if (body < 0) return;
    const angle = q[3 * body + 2] - drawn[3 * body + 2], c = Math.cos(angle), s = Math.sin(angle);
    const x = drawn[3 * body], y = drawn[3 * body + 1];
    found.set([q[3 * body] - c * x + s * y, q[3 * body + 1] - s * x - c * y, angle], 3 * k);
  });
  return found;
}

/** The place to which the motion of link k brings a place of the drawing; k = -1 is the ground. */
export function carry(motions, k, [x, y]) {
  if (k < 0) return [x, y];
  const c = Math.cos(motions[3 * k + 2]), s = Math.sin(motions[3 * k + 2]);
  return [motions[3 * k] + c * x - s * y, motions[3 * k + 1] + s * x + c * y];
}

/** The place of the drawing that the motion of link k brings to [x, y]. */
export function carryBack(motions, k, [x, y]) {
  if (k < 0) return [x, y];
  const c = Math.cos(motions[3 * k + 2]), s = Math.sin(motions[3 * k + 2]), dx = x - motions[3 * k], dy = y - motions[3 * k + 1];
  return [c * dx + s * dy, c * dy - s * dx];
}

/** Velocity and acceleration (m/s, m/s2) of a place [x, y] of a body in a state {q, v, a}; `a` is null if it is not known. */
export function ratesOf({q, v, a}, body, [x, y]) {
  const k = 3 * body, [dx, dy, w] = [x - q[k], y - q[k + 1], v[k + 2]];
  return {v: [v[k] - w * dy, v[k + 1] + w * dx], a: a && [a[k] - a[k + 2] * dy - w * w * dx, a[k + 1] + a[k + 2] * dx - w * w * dy]};
}
