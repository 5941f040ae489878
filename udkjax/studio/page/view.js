// The view of the drawing: a place (X, Y) in metres is at the pixel (x + scale X, y - scale Y).

export const ZOOM_STEP = 1.12;  // zoom factor of one notch of the wheel
const SMALLEST_SCALE = 1e-3, LARGEST_SCALE = 1e9;  // px/m: mechanisms from a kilometre to a micrometre

export const toPixels = (view, [x, y]) => [view.x + view.scale * x, view.y - view.scale * y];
export const toMetres = (view, [x, y]) => [(x - view.x) / view.scale, (view.y - y) / view.scale];

/** The view zoomed about a pixel, whose place stays put. */
export function zoomAt(view, [x, y], factor) {
  const scale = Math.min(Math.max(view.scale * factor, SMALLEST_SCALE), LARGEST_SCALE), ratio = scale / view.scale;
  return {scale, x: x + (view.x - x) * ratio, y: y + (view.y - y) * ratio};
}

/** The view of width x height pixels that fits points (m), with margins; without points, a square with sides of `size` (m). */
export function fit(points, width, height, size) {
  const xs = points.map(p => p[0]), ys = points.map(p => p[1]);
  let [left, right, bottom, top] = points.length ? [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)] : [0, size, 0, size];
  const least = points.length ? 0.2 * Math.max(right - left, top - bottom) || size : size;
  if (right - left < least) [left, right] = [(left + right - least) / 2, (left + right + least) / 2];
  if (top - bottom < least) [bottom, top] = [(bottom + top - least) / 2, (bottom + top + least) / 2];
  const margin = Math.min(70, 0.16 * Math.min(width, height));
  const scale = Math.min((width - 2 * margin) / (right - left), (height - 2 * margin) / (top - bottom));
  if (!Number.isFinite(scale) || !(scale > 0)) return fit([], width, height, size);
  return {scale, x: width / 2 - scale * (left + right) / 2, y: height / 2 + scale * (bottom + top) / 2};
}
