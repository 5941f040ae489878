// Fingers, mouse and wheel on a canvas.

/** Dragging moves the view or, in a live page, pulls the body under the pointer; two fingers and the wheel zoom, a tap plays or
 *  pauses, a double tap fits the view. */
export function followPointers(player, canvas, liveRun) {
  const down = new Map();
  let moved = 0, hand = null;  // distance moved, and the pointer that pulls
  const point = event => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  canvas.addEventListener("pointerdown", event => {
    if (event.button > 1) return;
    canvas.setPointerCapture(event.pointerId);
    down.set(event.pointerId, point(event));
    moved = 0;
    if (down.size === 1 && event.button === 0 && liveRun()?.bodyAt(canvas, point(event), event.pointerType)) hand = event.pointerId;
  });
  canvas.addEventListener("pointermove", event => {
    if (!down.has(event.pointerId)) {
      if (liveRun()) canvas.classList.toggle("holds", Boolean(liveRun().bodyAt(canvas, point(event), event.pointerType)));
      return;
    }
    const before = [...down.values()], old = down.get(event.pointerId), now = point(event);
    down.set(event.pointerId, now);
    moved += Math.hypot(now[0] - old[0], now[1] - old[1]);
    if (moved < 4) return;
    if (hand === event.pointerId) {
      if (liveRun().hand) liveRun().move(canvas, now);
      else if (!liveRun().grasp(canvas, old, event.pointerType)) hand = null;
      return;
    }
    const after = [...down.values()], centre = list => [0, 1].map(k => list.reduce((sum, p) => sum + p[k], 0) / list.length);
    const [cx, cy] = centre(before), [nx, ny] = centre(after);
    if (down.size === 2) {
      const apart = ([a, b]) => Math.hypot(a[0] - b[0], a[1] - b[1]);
      player.zoomAt(canvas, cx, cy, apart(after) / (apart(before) || 1));
    }
    player.zoom.x += nx - cx;
    player.zoom.y += ny - cy;
    player.draw();
  });
  const up = event => {
    if (hand === event.pointerId) { hand = null; liveRun().release(); }
    if (down.delete(event.pointerId) && event.type === "pointerup" && moved < 4) player.toggle("playing");
  };
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", up);
  canvas.addEventListener("dblclick", () => player.whole());
  canvas.addEventListener("wheel", event => {
    if (!player.options.fill && !event.ctrlKey && document.activeElement?.shadowRoot !== player.root.getRootNode()) return;
    event.preventDefault();
    player.zoomAt(canvas, ...point(event), Math.exp(-0.0015 * event.deltaY));
    player.draw();
  }, {passive: false});
}
