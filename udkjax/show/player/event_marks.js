// Events on the timeline: a tick for each, the name of the one that has just happened, and the joints that stick.

import {make} from "./elements.js";
import {contextOf} from "./painter.js";

const THUMB = 8, TICK = 7;  // px: half the width of the slider's thumb, by which the timeline is inset; height of a tick
const NAME_SHOWN = 0.04;  // fraction of the timeline during which the name of an event is shown

export class EventMarks {
  constructor(player) {
    this.player = player;
    this.canvas = make("canvas", {class: "ticks", "aria-hidden": "true"});
    this.element = make("div", {class: "line"}, player.scrub, this.canvas);
  }

  draw() {
    const {runs, panels, data: {start, end}, theme, t} = this.player, {context, width, height} = contextOf(this.canvas);
    runs.forEach((run, k) => {
      context.beginPath();
      for (const event of run.events) {
        const x = THUMB + (width - 2 * THUMB) * (event.t - start) / (end - start || 1);
        context.moveTo(x, height - TICK);
        context.lineTo(x, height);
      }
      context.lineWidth = 2;
      context.strokeStyle = runs.length > 1 ? theme.bodies[k % theme.bodies.length] : theme.force;
      context.stroke();
      const last = run.events.findLast(event => event.t <= t && event.t >= t - NAME_SHOWN * (end - start));
      const stuck = run.stuck(t).map(({name}) => name), now = stuck.length ? `${stuck.join(", ")} ${stuck.length > 1 ? "stick" : "sticks"}` : "";
      const words = [now, last ? `${last.name}, ${+last.t.toPrecision(5)} s` : ""].filter(Boolean).join("; ");
      if (panels[k].happened.textContent !== words) panels[k].happened.textContent = words;
    });
  }
}
