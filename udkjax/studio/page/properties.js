// The fields of the selected element: each value with its unit, as written in the file.

import {groundOf, list, movePin, nameOf, pinsOf, placeOf, renameElement, renamePin, toggleGround, withKey, withValue} from "./document.js";
import {readValue, valueText} from "./values.js";
import {shapeProblem} from "./checks.js";
import {copy} from "./clipboard.js";
import {remove} from "./keys.js";
import {lengthOf, withTypedBar} from "./dimensions.js";
import {numberFields} from "./number_fields.js";
import {swapPair} from "./actions.js";
import {camFields} from "./cam_fields.js";
import {carry} from "./motions.js";
import {formWords, formsOf} from "./pin_forms.js";
import {barPins} from "./shapes.js";
import {angle, angleUnit, angleWritten, direction, expressed, length, lengthName, lengthUnit, placeFrom, readMeasure, shown, tidy, usesNumbers} from "./units.js";
import {make} from "./player/elements.js";

// The editable keys of each kind of element, and the kind of quantity of each.
const KEYS = {
  link: [["pins", "names"], ["density", "density"], ["width", "length"], ["thickness", "length"], ["mass", "mass"], ["inertia", "inertia"], ["centre", "length"], ["outline", "length"]],
  slide: [["link", "name"], ["along", "names"], ["direction", "direction"], ["on", "name"]],
  slot: [["pin", "name"], ["along", "names"], ["direction", "direction"], ["on", "name"], ["link", "name"]],
  gear: [["links", "names"], ["teeth", "count"], ["radii", "length"], ["internal", "yes"], ["carrier", "name"]],
  cam: [["pins", "names"], ["links", "names"], ["profile.angle", "angle"], ["profile.radius", "length"]],
  motor: [["pin", "name"], ["slide", "name"], ["between", "names"], ["of", "names"], ["speed", "speed"], ["torque", "torque"], ["motion", "motion"]],
  spring: [["between", "names"], ["pin", "name"], ["of", "names"], ["stiffness", "stiffness"], ["length", "length"], ["angle", "angle"], ["damping", "damping"]],
  damper: [["between", "names"], ["pin", "name"], ["of", "names"], ["damping", "damping"]],
  load: [["pin", "name"], ["link", "name"], ["force", "force"], ["torque", "torque"], ["frame", "name"]],
};
// The keys that are always shown; others are shown if the element has them, and offered in a list if not.
const USUAL = {link: ["pins"], slide: ["link"], slot: ["pin"], gear: ["links"], cam: ["pins"], motor: [], spring: ["stiffness", "length"], damper: ["damping"], load: []};
const EXAMPLES = {density: "7850", mass: "0.2 kg", inertia: "1e-4 kg m2", speed: "60 rpm", torque: "1 N m", stiffness: "1 N/mm", damping: "10 N s/m",
  force: "[0 N, -10 N]", angle: "30 deg", direction: "30 deg"};
const SI = {density: "kg/m³", mass: "kg", inertia: "kg m²", speed: "rad/s", torque: "N m", stiffness: "N/m", damping: "N s/m", force: "N", angle: "rad", direction: "rad", length: "m"};

/** The unit of numbers of a quantity that are written without a unit. */
function unitOf(document, quantity) {
  const chosen = document.units?.[{speed: "angular_velocity", direction: "angle"}[quantity] ?? quantity];
  if (quantity === "speed" && !chosen && (document.units?.angle ?? "rad") !== "rad") return "";  // the reader refuses a number without a unit here, as ambiguous
  return chosen ?? SI[quantity] ?? "";
}

/** The distances of the pins of a link that follow each other: those of a plate all around. */
function lengthsText(document, {pins = [], width, outline}) {
  const isBar = pins.length === 2 || (width !== undefined && !outline), closed = isBar ? pins : [...pins, ...pins.slice(0, 1)];
  const pairs = closed.slice(1).map((pin, k) => [closed[k], pin]);
  if (isBar && pins.length > 2) pairs.unshift([pins[0], pins.at(-1)]);
  const text = ([a, b]) => {
    const [p, q] = [placeOf(document, a), placeOf(document, b)];
    return p && q ? `${a}–${b} ${+(Math.hypot(q[0] - p[0], q[1] - p[1]) / lengthUnit(document)).toPrecision(6)}` : "";
  };
  const found = pins.length > 1 ? pairs.map(text).filter(Boolean) : [];
  return found.length ? `length ${found.join(", ")} ${lengthName(document)}` : "";
}

export class PropertiesPanel {
  constructor(studio, element) { Object.assign(this, {studio, element, added: new Set()}); }

  show() {
    const {studio} = this, [item, ...more] = studio.selection;
    const key = JSON.stringify([studio.selection, studio.document, studio.motion.pageEngine !== null]);
    if (key === this.last) return;
    if (JSON.stringify(studio.selection) !== this.of) this.added.clear();
    Object.assign(this, {last: key, of: JSON.stringify(studio.selection)});
    if (!item) return this.element.replaceChildren(...this.general());
    const parts = more.length ? [make("p", {}, `${1 + more.length} selected`)] : item.kind === "pin" ? this.pin(item.name) : this.entry(item);
    const buttons = [make("button", {type: "button", onclick: () => remove(studio)}, "Delete")];
    return this.element.replaceChildren(...parts, make("div", {class: "group"}, ...buttons, make("button", {type: "button", onclick: () => copy(studio)}, "Duplicate")));
  }

  /** A field for a value; `take` gets the text when editing ends. */
  field(label, value, unit, take, example = "") {
    const input = make("input", {type: "text", value, placeholder: example, "aria-label": label, spellcheck: "false"});
    input.addEventListener("change", () => take(input.value.trim()));
    input.addEventListener("keydown", event => {
      if (event.key === "Enter") input.blur();
      if (event.key === "Escape") { input.value = value; input.blur(); }
    });
    return make("label", {class: "field"}, make("span", {}, label), input, make("span", {class: "unit"}, unit));
  }

  set(document, select = null) {
    const problem = shapeProblem(document);
    if (problem) return this.refuse(problem);
    this.studio.say("");
    if (!this.studio.commit(document, select)) this.again();
    return undefined;
  }

  /** Show the drawing with a number that was typed, and what gave way; or say why it is not possible. */
  take({document, note, problem}) {
    if (problem) return this.refuse(problem);
    this.set(document);
    return note && this.studio.say(note);
  }

  /** Restore the fields, and say why nothing changed. */
  refuse(words) {
    this.studio.say(words, true);
    this.again();
  }

  again() {
    this.last = null;
    this.show();
  }

  general() {
    const {document} = this.studio, change = (key, value) => {
      const {[key]: _, ...rest} = document;
      this.set(value === "" || value === undefined ? rest : {...document, [key]: value});
    };
    const units = document.units ?? {}, unit = (key, names, usual) => {
      const select = make("select", {"aria-label": `unit of ${key}`, onchange: () => change("units", {...units, [key]: select.value})}, ...names.map(name => make("option", {value: name}, name)));
      select.value = units[key] ?? usual;
      select.title = "Unit of numbers without a unit. Changing it does not convert them.";
      return make("label", {class: "field"}, make("span", {}, `${key} unit`), select, make("span", {class: "unit"}));
    };
    return [make("h3", {}, "mechanism"),
      this.field("name", document.name ?? "", "", value => change("name", value), "e.g. four-bar"),
      this.field("gravity", valueText(document.gravity), unitOf(document, "acceleration") || "m/s²", value => change("gravity", readValue(value)), "[0, -9.81 m/s2]"),
      unit("length", ["mm", "cm", "m", "in", "ft"], "m"), unit("angle", ["deg", "rad"], "rad"), ...numberFields(this),
    ];
  }

  /** The fields of a pin: its coordinates, or the numbers of its form. */
  place(name) {
    const {document} = this.studio, value = pinsOf(document)[name] ?? ["", ""];
    const put = next => this.set({...document, pins: {...pinsOf(document), [name]: next}});
    const take = (quantity, change) => text => {
      const next = this.read(text, quantity), read = {length, angle}[quantity] ?? (x => (typeof x === "number" ? x : NaN));
      if (!Number.isFinite(read(next, document))) return this.refuse(`"${text}" is not ${{length: "a length: write 12 or 12 mm", angle: "an angle: write 30 or 30 deg"}[quantity] ?? "a number: write 0.5"}, for example`);
      return put(change(next));
    };
    const unitAt = (x, quantity) => (usesNumbers(x, document) ? this.valueWords(x, quantity) : unitOf(document, quantity));
    const numbers = (key, quantity, values, names) => values.map((x, k) => this.field(names?.[k] ?? key, valueText(x), unitAt(x, quantity),
      take(quantity, next => (key === "" ? value.with(k, next) : {...value, [key]: Array.isArray(value[key]) ? value[key].with(k, next) : next}))));
    const polar = text => (text.includes("@") ? placeFrom(text, [0, 0], document) : null);
    if (Array.isArray(value)) {
      const fields = numbers("", "length", value, ["x", "y"]);
      for (const field of fields) field.querySelector("input").addEventListener("change", event => {  // 50 @ 60 gives both
        const to = polar(event.target.value);
        if (to) { event.stopImmediatePropagation(); this.set(movePin(document, name, to)); }
      }, true);
      return fields;
    }
    const from = [value.from].flat(), line = value.line ? ` from ${value.line.join("-")}` : "";
    return Object.entries(value).flatMap(([key, x]) => {
      if (key === "length") return numbers(key, "length", [x].flat(), from.map(other => `from ${other}`));
      if (key === "angle") return numbers(key, "angle", [x], [`angle${line}`]);
      if (key === "off") return numbers(key, "length", [x], ["off the line"]);
      if (key === "share") return numbers(key, "", [x], [`share of ${value.from}-${value.to}`]);
      const isNames = key !== "along";
      return [this.field(key, valueText(x), "", text => put({...value, [key]: readValue(text, isNames)}))];
    });
  }

  /** A choice of the form of a pin; choosing one keeps its place. */
  form(name) {
    const {document} = this.studio, links = list(document, "link").filter(link => link.pins?.includes(name));
    const now = formWords(pinsOf(document)[name]), others = formsOf(document, name, links.flatMap(link => link.pins).filter(other => other !== name)).filter(([words]) => words !== now);
    return this.choice("given by", now, others.map(([words], k) => [words, `${k}`]), k => this.set({...document, pins: {...pinsOf(document), [name]: others[+k][1]}}));
  }

  /** A list [words, value] of which one is chosen. */
  choice(label, prompt, options, take, title = label) {
    const select = make("select", {"aria-label": title}, make("option", {value: ""}, prompt), ...options.map(([words, value]) => make("option", {value}, words)));
    select.addEventListener("change", () => select.value && take(select.value));
    return make("label", {class: "field"}, make("span", {}, label), select, make("span", {class: "unit"}));
  }

  read(text, quantity) { return readMeasure(text, quantity, this.studio.document); }

  /** The value of an expression of named numbers, with its unit. */
  valueWords(text, quantity) { return `= ${tidy(+expressed(text, quantity, this.studio.document)?.toPrecision(6))} ${unitOf(this.studio.document, quantity)}`; }

  /** Length and angle of a bar as fields, the lengths of a bar of more than two pins and of another link; and its mass. */
  shape(link) {
    const {studio, studio: {document}} = this, {pageEngine} = studio.motion, isKnown = pageEngine && !pageEngine.scene.massless.includes(link.name), mass = isKnown ? pageEngine.masses().get(link.name) : undefined;
    const facts = [mass === undefined || link.mass !== undefined ? "" : `mass ${shown(mass, "kg")}`].filter(Boolean).map(words => make("p", {}, words));
    const chain = barPins(document, link), ends = chain.length > 2 ? [chain[0], chain.at(-1)] : link.pins ?? [], [a, b] = ends.map(pin => placeOf(document, pin));
    if (ends.length !== 2 || !a || !b) return [make("p", {}, lengthsText(document, link)), ...facts];
    const size = Math.hypot(b[0] - a[0], b[1] - a[1]), turn = Math.atan2(b[1] - a[1], b[0] - a[0]);
    const own = lengthOf(document, link)?.value, isNamed = usesNumbers(own, document);
    const field = (quantity, value, unit) => this.field(quantity, value, unit, text => this.take(withTypedBar(document, {...link, pins: ends}, text, quantity)));
    const shownSize = isNamed ? own : tidy(+(size / lengthUnit(document)).toPrecision(9)), sizeUnit = isNamed ? this.valueWords(own, "length") : lengthName(document);
    const way = field("angle", tidy(+(turn / angleUnit(document)).toPrecision(9)), unitOf(document, "angle"));
    return chain.length > 2 ? [make("p", {}, lengthsText(document, link)), way, ...facts] : [field("length", shownSize, sizeUnit), way, ...facts];
  }

  /** Say where a selected pin is while the mechanism is away from its drawn position. */
  showNow() {
    const {studio} = this, [item] = studio.selection, place = item?.kind === "pin" && studio.isMoved ? placeOf(studio.document, item.name) : null;
    if (!this.now) return;
    const at = place && carry(studio.motions, studio.canvas.carrier(studio.document, item.name), place).map(x => shown(x / lengthUnit(studio.document), ""));
    this.now.textContent = at ? `now at ${at.join(", ")} ${lengthName(studio.document)}` : "";
  }

  pin(name) {
    const {studio} = this, {document} = studio;
    const rename = to => {
      const found = renamePin(document, name, to);
      if (found === document && to !== name) return this.refuse(to ? `another pin is called ${to}` : "a pin needs a name");
      return this.set(found, [{kind: "pin", name: to}]);
    };
    const fixed = make("input", {type: "checkbox", "aria-label": "fixed to the ground"});
    fixed.checked = groundOf(document).includes(name);
    fixed.addEventListener("change", () => this.set(toggleGround(document, name)));
    return [make("h3", {}, `pin ${name}`),
      this.field("name", name, "", rename),
      ...this.place(name), this.form(name), this.now = make("p", {class: "now"}),
      make("label", {class: "field check"}, make("span", {}, "fixed"), fixed, make("span", {class: "unit"}))];
  }

  entry({kind, index}) {
    const {studio} = this, {document} = studio, entry = list(document, kind)[index] ?? {}, title = nameOf(document, kind, index);
    const keys = (KEYS[kind] ?? []).filter(([path]) => !entry.profile?.law || !path.startsWith("profile."));
    const isShown = ([path]) => (USUAL[kind] ?? []).includes(path) || path.split(".")[0] in entry, more = keys.filter(one => !isShown(one) && !this.added.has(one[0]));
    const fields = keys.filter(one => !more.includes(one)).map(([path, quantity]) => {
      const [key, sub] = path.split("."), given = sub ? entry[key]?.[sub] : entry[key];
      const value = quantity === "direction" && Array.isArray(given) ? angleWritten(direction(given, document), document) : given, plain = value === undefined || typeof [value].flat(2)[0] === "number";
      const take = text => {
        const value = this.read(text, quantity), next = quantity === "names" && typeof value === "string" ? [value] : value;
        this.set(withValue(document, kind, index, key, sub ? {...entry[key], [sub]: next} : next));
      };
      const unit = plain ? unitOf(document, quantity) : "";
      return this.field(sub ?? key, valueText(value), unit, take, EXAMPLES[quantity] ? `e.g. ${EXAMPLES[quantity]}` : "");
    });
    const extra = Object.keys(entry).filter(key => key !== "name" && !(KEYS[kind] ?? []).some(([path]) => path.split(".")[0] === key));
    const rename = to => {
      const found = renameElement(document, kind, index, to);
      if (found === document && to !== title) return this.refuse(to ? `another ${kind} is called ${to}` : `a ${kind} needs a name`);
      return this.set(found);
    };
    const lengths = kind === "link" ? this.shape(entry) : [], units = {angle: unitOf(document, "angle"), length: lengthName(document), step: entry.profile?.swing ? "angle" : "length"};
    if (kind === "cam") fields.push(...camFields(this, entry, index, units));
    if (more.length) fields.push(this.choice("more", "more …", more.map(([path]) => [path, path]), path => { this.added.add(path); this.again(); }));
    const parts = [make("h3", {}, `${kind} ${title}`), this.field("name", entry.name ?? "", "", rename, title), ...lengths, ...fields,
      ...extra.map(key => this.field(key, valueText(entry[key]), "", text => this.set(withKey(document, kind, index, key, readValue(text)))))];
    if (Array.isArray(entry.of) && entry.of.length === 2) parts.push(make("button", {type: "button", onclick: () => this.set(swapPair(document, kind, index))}, "Swap the two links"));
    return parts;
  }
}
