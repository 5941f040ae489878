// The sheet that the browser prints: the drawing with its dimensions, the curves, and the answers; in the light theme.

import {wear} from "./layout.js";
import {make} from "./player/elements.js";

export function followPrinting(studio, root) {
  let sheet = null;
  window.addEventListener("beforeprint", () => {
    sheet?.remove();
    sheet = sheetOf(studio);
    root.append(sheet);
  });
  window.addEventListener("afterprint", () => { sheet?.remove(); sheet = null; });
}

function sheetOf(studio) {
  const {chosenTheme, parts, curves} = studio;
  studio.chosenTheme = "light";
  studio.retheme();
  studio.draw();
  const pictures = [[parts.canvas, "the drawing"], ...(curves.name ? [[curves.canvas, curves.name]] : [])]
    .map(([canvas, title]) => make("figure", {}, make("img", {src: canvas.toDataURL("image/png"), alt: title}), ...(canvas === parts.canvas ? [] : [make("figcaption", {}, title)])));
  studio.chosenTheme = chosenTheme;
  studio.retheme();
  const sheet = make("section", {class: "print-sheet answers"}, make("h1", {}, studio.document.name || parts.title.title), ...pictures,
    make("div", {class: "body"}, ...[...parts.answers.childNodes].map(node => node.cloneNode(true))));
  wear(sheet, "light");
  return sheet;
}
