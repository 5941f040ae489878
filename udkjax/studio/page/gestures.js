// Mouse, pen and fingers on the drawing. A gesture adds at most one undo step, and none if nothing moved; a cancelled gesture
// (another finger, Esc, a lost pointer) leaves the drawing as it was.

import {mergePins, movePin, placeOf, pinsOfItems, settle, shiftPins} from "./document.js";
import {snapOnLink} from "./joining.js";
import {itemAt, itemsWithin, pinAt, same} from "./picking.js";
import {toolOf} from "./tools.js";
import {toMetres, zoomAt, ZOOM_STEP} from "./view.js";

const CLICK = 4;  // px: a gesture that moves less is a click
const SNAP = 9;  // px: from middles and crossings of bars
const WHEEL_LINE = 100;  // px of one notch

export class Gestures {
  /** `studio` has document, selection, tool, view, snap(place, event), and canvas with places and outlines. */
  constructor(studio, element) {
    Object.assign(this, {studio, element, pointers: new Map(), now: null, corners: [], start: null});
    const on = (name, action, options) => element.addEventListener(name, action, options);
    on("pointerdown", event => this.down(event));
    on("pointermove", event => this.move(event));
    on("pointerup", event => this.up(event));
    on("pointercancel", event => this.lost(event));
    on("lostpointercapture", event => { if (this.pointers.has(event.pointerId)) this.lost(event); });
    on("dblclick", () => this.finish());
    on("wheel", event => this.wheel(event), {passive: false});
    on("contextmenu", event => event.preventDefault());
  }

  pixel(event) {
    const box = this.element.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  /** The position of a pointer, and the pin, link or slide under it. */
  target(event, except = null) {
    const {studio} = this, pixel = this.pixel(event), touch = event.pointerType === "touch";
    const pin = pinAt(studio.canvas.places, pixel, touch, except);
    const under = kind => (pin === null ? itemAt(studio.canvas.outlines, studio.canvas.places, pixel, touch, [kind]) : null), found = under("link");
    const free = toMetres(studio.view, pixel), mark = found && !event.altKey ? snapOnLink(studio.document, found.index, free, SNAP / studio.view.scale) : null;
    const place = pin === null ? mark ?? studio.snap(free, event) : placeOf(studio.document, pin);
    return {pixel, pin, link: found?.index ?? null, slide: under("slide")?.index ?? null, place, free};
  }

  down(event) {
    if (event.button > 1) return undefined;
    const pixel = this.pixel(event);
    this.element.setPointerCapture(event.pointerId);
    this.element.focus({preventScroll: true, focusVisible: false});  // now, so that a field commits its text before the gesture begins
    if (this.studio.source.timer) return this.studio.say("the edited text is still being read: try again");
    this.studio.draw();
    this.studio.isFresh = false;  // the view stays as it is under the hand, whatever the motion shows
    this.pointers.set(event.pointerId, pixel);
    if (this.pointers.size > 1) return this.cancel();
    this.moved = false;
    this.from = pixel;
    const tool = toolOf(this.studio.tool);
    if (event.button === 1) this.now = {kind: "pan"};
    else if (tool.kind) this.press(tool, event);
    else this.grasp(event);
  }

  /** A press with a drawing tool. */
  press(tool, event) {
    if (this.studio.isMoved) this.studio.rewind();
    const target = this.target(event);
    if (tool.kind === "stroke") this.studio.wanted.begin(target.free);
    this.now = {kind: "draw", tool, target};
    if (tool.kind === "points" && !this.start) this.studio.preview = {from: target, to: target};
  }

  /** A press with the select or pull tool. */
  grasp(event) {
    const {studio} = this, touch = event.pointerType === "touch", pixel = this.pixel(event);
    const item = itemAt(studio.canvas.outlines, studio.canvas.places, pixel, touch);
    if (studio.tool === "pull" || (studio.isMoved && item)) {
      const goesOn = studio.motion.playing;
      this.now = item && studio.canPull(item) ? {kind: "pull", item, at: toMetres(studio.view, pixel), goesOn} : {kind: "pan"};
      if (item) studio.select([item]);
      if (this.now.kind === "pull") studio.motion.pause();
      return;
    }
    const mark = item?.kind === "pin" ? null : studio.dimensions.at(pixel);
    if (mark) {
      this.now = {kind: "pan", mark};
      return;
    }
    if (!item) {
      this.now = event.shiftKey ? {kind: "area"} : {kind: "pan", clears: true};
      return;
    }
    if (event.shiftKey || event.ctrlKey || event.metaKey) {
      const has = studio.selection.some(other => same(other, item));
      studio.select(has ? studio.selection.filter(other => !same(other, item)) : [...studio.selection, item]);
    } else if (!studio.selection.some(other => same(other, item))) studio.select([item]);
    const isAmong = studio.selection.length > 1 && !event.shiftKey && !event.ctrlKey && !event.metaKey;  // a click selects it alone, a drag moves all
    const pins = pinsOfItems(studio.document, studio.selection);
    this.now = {kind: "drag", item, isAmong, pins, before: studio.document, start: toMetres(studio.view, pixel)};
  }

  move(event) {
    const {studio} = this, pixel = this.pixel(event);
    this.element.classList.toggle("on-text", studio.tool === "select" && Boolean(studio.dimensions.at(pixel)));
    if (!this.pointers.has(event.pointerId)) return studio.hover(itemAt(studio.canvas.outlines, studio.canvas.places, pixel), this.start || this.corners.length ? this.follow(event) : null);
    const before = [...this.pointers.values()];
    this.pointers.set(event.pointerId, pixel);
    if (this.pointers.size === 2) return this.pinch(before, [...this.pointers.values()]);
    if (!this.moved && Math.hypot(pixel[0] - this.from[0], pixel[1] - this.from[1]) < CLICK) return undefined;
    const first = !this.moved;
    this.moved = true;
    const {kind} = this.now ?? {};
    if (kind === "pan") studio.pan(pixel[0] - before[0][0], pixel[1] - before[0][1]);
    else if (kind === "area") studio.preview = {area: [this.from, pixel]};
    else if (kind === "pull") {
      if (first) studio.motion.beginPull(this.now.item, this.now.at);
      studio.motion.pullTo(toMetres(studio.view, pixel));
    }
    else if (kind === "drag") this.drag(event, pixel);
    else if (kind === "draw") this.stretch(event, first);
    studio.redraw();
    return undefined;
  }

  /** Move the dragged pins; pins that belong on lines are moved back onto them. */
  drag(event, pixel) {
    const {studio, now} = this, at = toMetres(studio.view, pixel), {pins, before} = now;
    if (!pins.length) return;
    let found;
    if (pins.length === 1) found = movePin(before, pins[0], studio.snap(at, event));
    else {
      const anchor = now.item.kind === "pin" ? now.item.name : pins[0], start = placeOf(before, anchor);
      const to = studio.snap([start[0] + at[0] - now.start[0], start[1] + at[1] - now.start[1]], event);
      found = shiftPins(before, pins, to[0] - start[0], to[1] - start[1]);
    }
    now.onto = pins.length === 1 ? pinAt(studio.canvas.placesOf(before, pins), pixel, event.pointerType === "touch", pins[0]) : null;
    if (now.onto) found = movePin(before, pins[0], placeOf(before, now.onto));
    studio.propose(settle(found));
    studio.preview = now.onto ? {onto: now.onto} : null;
  }

  stretch(event, first) {
    const {studio, now} = this;
    if (now.tool.kind === "stroke") studio.wanted.go(toMetres(studio.view, this.pixel(event)));
    if (now.tool.kind === "points") {
      if (first && !this.start) this.start = null;
      studio.preview = {from: this.start ?? now.target, to: this.target(event, null)};
    }
  }

  /** The line to the pointer, between the two clicks of a tool. */
  follow(event) {
    const to = this.target(event);
    return this.corners.length ? {corners: [...this.corners, to]} : {from: this.start, to};
  }

  up(event) {
    const {studio, now} = this;
    if (!this.pointers.delete(event.pointerId)) return;
    if (!now || this.pointers.size) return;
    this.now = null;
    studio.preview = null;
    if (now.kind === "pan" && !this.moved && now.mark) studio.dimensions.open(now.mark);
    else if (now.kind === "pan" && !this.moved && now.clears) studio.select([]);
    else if (now.kind === "area" && this.moved) studio.select(itemsWithin(studio.document, studio.canvas.places, this.from, this.pixel(event)));
    else if (now.kind === "pull") this.letGo(now);
    else if (now.kind === "drag" && this.moved) this.drop(now);
    else if (now.kind === "drag" && now.isAmong) studio.select([now.item]);
    else if (now.kind === "draw") this.release(now, this.target(event));
    studio.redraw();
  }

  drop({pins, onto, before}) {
    const {studio} = this;
    if (onto) {
      studio.commit(settle(mergePins(before, pins[0], onto)), [{kind: "pin", name: onto}]);
    } else studio.commit(studio.document);
  }

  /** End a pull. One that moved nothing was a click, after which a running motion continues. */
  letGo({goesOn}) {
    if (this.moved) this.studio.motion.endPull(); else if (goesOn) this.studio.motion.play();
  }

  /** A place for the tool in hand that was typed: as a click there. */
  give(target) {
    this.moved = false;
    this.release({tool: toolOf(this.studio.tool), target}, target);
  }

  /** A release with a drawing tool: one click of several, or the end of the whole gesture. */
  release({tool, target}, end) {
    const {studio} = this, context = studio.context;
    if (tool.kind === "stroke") return studio.wanted.end();
    if (tool.kind === "click") return studio.apply(tool.make(studio.document, target, context));
    if (tool.kind === "corners") return this.corner(tool, target, context);
    if (this.moved && !this.start) return studio.apply(tool.make(studio.document, target, end, context));
    if (!this.start && tool.click) return studio.apply(tool.click(studio.document, target, context));
    if (!this.start) {
      this.start = target;
      studio.preview = {from: target, to: target};
      return undefined;
    }
    const from = this.start, isClick = from.pin !== null && from.pin === end.pin;
    this.start = null;
    return studio.apply(tool.make(studio.document, from, {...end, isClick}, context));
  }

  corner(tool, target, context) {
    const {studio, corners} = this, [first] = corners;
    const closes = corners.length > 2 && (target.pin ? target.pin === first.pin
      : Math.hypot(target.pixel[0] - first.pixel[0], target.pixel[1] - first.pixel[1]) < 12);
    if (closes) {
      this.corners = [];
      return studio.apply(tool.make(studio.document, corners, context));
    }
    this.corners = [...corners, target];
    studio.preview = {corners: this.corners};
    return undefined;
  }

  /** Finish a plate by Enter or a double click, without a click on its first corner; returns whether there was one. */
  finish() {
    const tool = toolOf(this.studio.tool);
    if (tool.kind !== "corners" || this.corners.length < 3) return false;
    const corners = this.corners.filter((c, k, all) => !k || Math.hypot(c.pixel[0] - all[k - 1].pixel[0], c.pixel[1] - all[k - 1].pixel[1]) > CLICK);
    this.corners = [];
    this.studio.apply(tool.make(this.studio.document, corners, this.studio.context));
    return true;
  }

  pinch([a, b], [c, d]) {
    const {studio} = this, centre = (p, q) => [(p[0] + q[0]) / 2, (p[1] + q[1]) / 2], apart = (p, q) => Math.hypot(p[0] - q[0], p[1] - q[1]);
    const from = centre(a, b), to = centre(c, d);
    studio.setView(zoomAt({...studio.view, x: studio.view.x + to[0] - from[0], y: studio.view.y + to[1] - from[1]}, to, apart(c, d) / (apart(a, b) || 1)));
  }

  wheel(event) {
    event.preventDefault();
    const notches = event.deltaMode === 0 ? event.deltaY / WHEEL_LINE : event.deltaY / 3;
    this.studio.setView(zoomAt(this.studio.view, this.pixel(event), ZOOM_STEP ** -Math.max(-5, Math.min(5, notches))));
  }

  lost(event) {
    this.pointers.delete(event.pointerId);
    this.cancel();
  }

  /** Cancel the gesture and restore the drawing; returns whether there was one. */
  cancel() {
    const {studio, now} = this, was = Boolean(now || this.start || this.corners.length);
    if (now?.kind === "drag") studio.propose(now.before);
    if (now?.kind === "pull") studio.motion.endPull();
    if (now?.tool?.kind === "stroke") studio.wanted.remove();
    Object.assign(this, {now: null, start: null, corners: []});
    studio.preview = null;
    studio.redraw();
    return was;
  }
}
