// Elements of a page, and their texts.

export const SPEEDS = [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100];
const ICONS = {
  play: "M7 4.5v15l13-7.5z",
  pause: "M6 4.5h4.2v15H6zM13.8 4.5H18v15h-4.2z",
  loop: "M17 3l4 4-4 4V8H8a3 3 0 0 0-3 3v1H3v-1a5 5 0 0 1 5-5h9zM7 21l-4-4 4-4v3h9a3 3 0 0 0 3-3v-1h2v1a5 5 0 0 1-5 5H7z",
  theme: "M12 3a9 9 0 1 0 0 18zM12 3a9 9 0 0 1 0 18v-2a7 7 0 0 0 0-14z",
};
export const HELP = [
  ["Space", "play, pause"], ["← →", "one frame back, forward"], ["Shift ← →", "5 % back, forward"], ["Home End", "start, end"],
  ["+ −", "faster, slower"], ["T", "traces"], ["N", "names"], ["R", "reactions"], ["L", "repeat"], ["D", "dark or light"],
  ["0", "fit the view"], ["Wheel, pinch", "zoom"], ["Drag", "move the view"],
];

export const LIVE_HELP = [["Drag a body", "pull it"], ["G", "show the first motion"], ["Backspace", "reset the numbers"]];

/** An element with properties and children; strings become text, never markup. */
export function make(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(properties)) {
    if (key === "class") element.className = value;
    else if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else element.setAttribute(key, value);
  }
  element.append(...children);
  return element;
}

export function button(content, title, action, kind = "") {
  return make("button", {type: "button", class: kind, title, "aria-label": title, onclick: action}, content);
}

export const icon = name => svgIcon(ICONS[name]);

/** An icon from an SVG path, filled or stroked. */
export function svgIcon(shape, isLine = false) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg"), path = document.createElementNS(svg.namespaceURI, "path");
  svg.setAttribute("viewBox", "0 0 24 24");
  svg.setAttribute("aria-hidden", "true");
  if (isLine) svg.classList.add("stroke");
  path.setAttribute("d", shape);
  path.setAttribute("fill-rule", "evenodd");
  svg.append(path);
  return svg;
}

/** Move the keyboard focus from clicked buttons to `focused`: otherwise the space bar would press the button again. */
export function keepKeys(root, focused) {
  root.addEventListener("mousedown", event => {
    if (!event.target.closest("button") || event.target.closest("dialog")) return;
    event.preventDefault();
    focused.focus({preventScroll: true, focusVisible: false});
  });
}
