// Sharing a drawing by address: one word with the whole text of its file, which fits in a message and opens in any studio.

import {ask} from "./api.js";
import {list} from "./document.js";
import {make} from "./player/elements.js";

/** Show the address of the drawing, with a button that copies it. */
export async function share(studio) {
  const {files} = studio;
  try {
    const text = await files.text();
    if (!text) return studio.say("nothing is drawn yet that could be shared");
    const {address} = await ask("share", {text});
    const area = make("textarea", {readonly: "", rows: 5, "aria-label": "address of this drawing"}, address);
    const apart = list(studio.document, "link").map(({outline}) => outline).filter(outline => typeof outline === "string");
    files.dialog("Share this drawing",
      make("p", {}, "This address holds the whole drawing. Paste it into a studio (Ctrl V, or under Open), or start one with it: ", make("code", {}, "udkjax studio ADDRESS")),
      area, ...(apart.length ? [make("p", {class: "warn"}, `It does not hold ${[...new Set(apart)].join(", ")}: send these files as well.`)] : []),
      make("p", {}, "Export writes a live page (.html) for those who have no udkjax: it moves in any browser."),
      files.buttons(["Close"], ["Copy", () => copyFrom(area, studio), "strong"]));
    return area.select();
  } catch (error) { return files.fail(error); }
}

/** Put the text of an area into the clipboard. */
async function copyFrom(area, studio) {
  try {
    await navigator.clipboard.writeText(area.value);
    studio.say("the address is in the clipboard");
  } catch { studio.say("this browser does not let pages copy: select the address under Share, and press Ctrl C", true); }
}

/** The field of the dialog in which files are opened that takes an address. */
export function addressField(studio) {
  const input = make("input", {type: "text", "aria-label": "address of a shared drawing", placeholder: "udkjax:drawing=…", spellcheck: "false"});
  const form = make("form", {method: "dialog"}, make("label", {class: "field wide"}, make("span", {}, "address of a shared drawing"), input));
  form.addEventListener("submit", event => { if (input.value.trim()) studio.files.openAddress(input.value); else event.preventDefault(); });
  return form;
}
