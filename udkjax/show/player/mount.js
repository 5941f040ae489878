// The player: shows the motion of planar mechanisms. Its modules have no dependencies; page.py joins them into one for a page or a
// notebook.
//
//   mount(element, data, {fill, theme, autoplay}) -> {time, playing, play(), pause(), seek(t), ...}     (see `mount`)
//   default export: {render} for anywidget
//
// `data` is described in udkjax/show/player/player_data.py. All texts go through `textContent` or a canvas, never through markup.

import {Player} from "./player.js";

/** Show `data` in an element.
 *
 *  options: fill (the whole window), theme ("light", "dark"; by default the preference of the system), autoplay.
 *  Returns an object with time, playing, play(), pause(), seek(t), speed, pixel(panel, x, y) -> [x, y] in the panel's canvas
 *  (CSS px), on(listener) and destroy(). The same object is the element's property `player`.
 */
export function mount(element, data, options = {}) {
  const player = new Player(element, data, options);
  const handle = {
    get time() { return player.t; },
    get playing() { return player.playing; },
    get speed() { return player.speed; },
    set speed(speed) { player.setSpeed(speed); },
    play: () => player.play(),
    pause: () => player.pause(),
    seek: t => player.seek(t),
    pixel: (panel, x, y) => {
      const {clientWidth, clientHeight} = player.panels[panel].canvas, view = player.view(clientWidth, clientHeight);
      return [view.x + view.scale * x, view.y - view.scale * y];
    },
    get live() { return player.live; },
    on: listener => player.on(() => listener(handle)),
    destroy: () => player.destroy(),
  };
  element.player = handle;
  element.dataset.lmSuppressShortcuts = "true";  // so that JupyterLab's shortcuts do not intercept keys
  return handle;
}

/** anywidget: the model has `data`, and `time` (s) and `playing`, which are synchronized with the player. */
function render({model, el}) {
  const player = mount(el, model.get("data"), {theme: model.get("theme") || null});
  const seek = () => { if (Math.abs(model.get("time") - player.time) > 1e-9) player.seek(model.get("time")); };
  const play = () => (model.get("playing") ? player.play() : player.pause());
  player.on(({time, playing}) => {
    model.set("time", time);
    model.set("playing", playing);
    model.save_changes();
  });
  model.on("change:time", seek);
  model.on("change:playing", play);
  if (model.get("time") > player.time) seek();
  if (model.get("playing")) play();
  return () => {
    model.off("change:time", seek);
    model.off("change:playing", play);
    player.destroy();
  };
}

export default {render};
