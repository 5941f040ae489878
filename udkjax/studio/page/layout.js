// The page: its bars, the drawing, and the panels around it.

import {share} from "./sharing.js";
import {KEYS, TOOLS} from "./tools.js";
import {VECTORS} from "./vectors.js";
import {button, icon, keepKeys, make, svgIcon} from "./player/elements.js";
import {THEMES} from "./player/painter.js";

/** Give an element the colours of a theme, by its name. */
export function wear(element, theme) {
  const {back, panel, ink, soft, line, accent, onAccent, force} = THEMES[theme];
  for (const [name, value] of Object.entries({back, panel, ink, soft, line, accent, force, "on-accent": onAccent})) element.style.setProperty(`--${name}`, value);
  element.style.colorScheme = theme;
}

const ICONS = {
  undo: "M9 5L4 10l5 5v-3.5h5a3.5 3.5 0 0 1 0 7H9v2h5a5.5 5.5 0 0 0 0-11H9z", redo: "M15 5l5 5-5 5v-3.5h-5a3.5 3.5 0 0 0 0 7h5v2h-5a5.5 5.5 0 0 1 0-11h5z",
  fit: "M4 4h6v2H6v4H4zM14 4h6v6h-2V6h-4zM4 14h2v4h4v2H4zM18 14h2v6h-6v-2h4z", home: "M6 5h2.5v14H6zM19 5v14L9 12z",
};

// Templates offered by an empty page.
const FIRST = [["crank_rocker", "Crank-rocker"], ["quick_return", "Quick return"], ["jansen_leg", "Walking leg"]];

/** Build the page in an element; returns its parts by name. */
export function buildPage(studio, root) {
  const parts = {};
  const section = (title, part, open = true) => {
    const found = make("details", {class: `panel ${part}`}, make("summary", {}, title), parts[part] = make("div", {class: "body"}));
    found.open = open;
    return found;
  };
  parts.title = make("h1", {}, "untitled");
  parts.undo = button(svgIcon(ICONS.undo), "undo (Ctrl+Z)", () => studio.undo(), "icon");
  parts.redo = button(svgIcon(ICONS.redo), "redo (Ctrl+Y)", () => studio.redo(), "icon");
  const files = make("nav", {class: "group", "aria-label": "file"},
    button("New", "new drawing (Ctrl+N)", () => studio.files.startNew()), button("Open", "open a file or a template (Ctrl+O)", () => studio.files.showOpen()),
    button("Save", "save (Ctrl+S)", () => studio.files.save(false)), button("Export", "export as page, picture, film, table or script", () => studio.files.showExport()),
    button("Share", "share the drawing by address", () => share(studio)));
  const header = make("header", {}, parts.title, files, make("div", {class: "group"}, parts.undo, parts.redo,
    button(svgIcon(ICONS.fit), "fit (F)", () => studio.fit(), "icon")), make("div", {class: "group end"},
    button(icon("theme"), "switch between dark and light", () => studio.switchTheme(), "icon"), button("?", "keyboard shortcuts (?)", () => studio.showHelp(), "icon")));
  parts.tools = TOOLS.map(tool => {
    const found = button(make("span", {}, tool.name), `${tool.title} (${tool.key.toUpperCase()})`, () => studio.setTool(tool.name), "tool");
    found.dataset.tool = tool.name;
    found.prepend(svgIcon(tool.icon, tool.stroke));
    return found;
  });
  parts.canvas = make("canvas", {tabindex: 0, role: "application", "aria-label": "drawing"});
  parts.status = make("p", {class: "status", role: "status"});
  const toggles = [["grid", "grid"], ["snap", "snap points to the grid (hold Alt to place them freely)"], ["names", "names"], ["paths", "paths of pins"], ["dimensions", "dimensions of the drawing: click one to change it"], ...Object.entries(VECTORS)].map(([name, title]) => {
    const found = button(name, title, () => {
      studio.show[name] = !studio.show[name];
      found.setAttribute("aria-pressed", studio.show[name]);
      studio.redraw();
    });
    found.setAttribute("aria-pressed", Boolean(studio.show[name]));
    return found;
  });
  parts.picture = make("div", {class: "group"});
  parts.entry = make("div", {class: "entry"});
  parts.dimension = make("div", {class: "dimension"});
  parts.wanted = make("div", {class: "wanted", role: "group", "aria-label": "wanted path"});
  const load = button("path", "read a wanted path from a table (CSV) of x and y", () => studio.wanted.input.click());
  const options = parts.options = make("details", {class: "toggles"}, make("summary", {}, "view"), make("div", {class: "group"}, ...toggles, load, parts.picture));
  const narrow = matchMedia("(max-width: 1000px)"), unfold = () => { options.open = !narrow.matches; };
  narrow.addEventListener("change", unfold);
  unfold();
  parts.welcome = make("div", {class: "welcome"}, make("h2", {}, "Draw a mechanism"),
    make("ol", {}, ...[["link", "Drag links from pin to pin"], ["ground", "Fix pins to the ground"], ["motor", "Put a motor on a pin and press play"]].map(([name, words]) => {
      const tool = TOOLS.find(one => one.name === name);
      return make("li", {}, button(svgIcon(tool.icon, tool.stroke), `${tool.title} (${tool.key.toUpperCase()})`, () => studio.setTool(name), "icon"),
        make("span", {}, words, " ", make("kbd", {}, tool.key.toUpperCase())));
    })), make("p", {}, "or start from an example"),
    make("div", {class: "group"}, ...FIRST.map(([name, words]) => button(words, `start from this example: ${words}`, () => studio.files.openTemplate(name))),
      button("More …", "open a file or a template (Ctrl+O)", () => studio.files.showOpen())));
  const stage = make("main", {}, parts.canvas, parts.welcome, options, parts.status, parts.entry, parts.wanted, parts.dimension);
  parts.play = button(icon("play"), "play (space)", () => studio.motion.toggle(), "icon primary");
  parts.home = button(svgIcon(ICONS.home), "back to the drawn position (Home)", () => studio.rewind(), "icon");
  parts.scrub = make("input", {type: "range", min: 0, max: 10000, step: 1, "aria-label": "time", oninput: () => {
    studio.motion.pause();
    studio.motion.seek(studio.motion.end * parts.scrub.value / 10000);
  }});
  parts.time = make("span", {class: "time"});
  parts.speed = make("select", {"aria-label": "speed", title: "speed", onchange: () => { studio.motion.speed = +parts.speed.value; }},
    ...[0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10].map(x => make("option", {value: x}, `${x} ×`)));
  parts.speed.value = 1;
  parts.goto = make("input", {type: "text", "aria-label": "go to", title: "go to an angle of the motor, as 60 deg, or to a time, as 0.3 s", placeholder: "60 deg", spellcheck: "false", class: "goto"});
  parts.goto.addEventListener("change", () => studio.motion.goTo(parts.goto.value));
  parts.loops = make("span", {class: "loops", role: "status"});
  parts.stop = button("Stop", "stop computing the motion", () => studio.motion.stop());
  parts.stop.hidden = true;
  parts.strip = make("section", {class: "strip", "aria-label": "curves"});
  const transport = make("footer", {}, parts.home, parts.play, parts.time, parts.goto, parts.scrub, parts.speed, parts.stop, parts.loops);
  const side = make("aside", {}, section("Findings", "findings"), section("Answers", "answers"), section("Selection", "properties"), section("Text (TOML)", "source"));
  parts.help = make("dialog", {class: "help", "aria-label": "keyboard shortcuts"}, make("h2", {}, "Keyboard shortcuts"),
    make("dl", {}, ...KEYS.flatMap(([key, words]) => [make("dt", {}, key), make("dd", {}, words)])),
    make("form", {method: "dialog"}, make("button", {class: "strong"}, "Close")));
  parts.dialog = make("dialog", {class: "sheet"});
  root.replaceChildren(header, make("div", {class: "tools", role: "toolbar", "aria-label": "tools"}, ...parts.tools), stage, side, parts.strip, transport, parts.help, parts.dialog);
  keepKeys(root, parts.canvas);
  return parts;
}
