// Panels of curves below the drawing; dragging along a curve moves the mechanism. Kinematics: positions, speeds, angles between
// links, travel of motors. Dynamics: energies, driving torques and forces from the engine in the page, forces at pins from the
// server. Statics: the equilibrium, and holding torques and forces of motors.

import {alongOf, turningMotors} from "./along.js";
import {ask} from "./api.js";
import {drawChart, valueAt} from "./chart.js";
import {list, members, nameOf, pinsOf, placeOf} from "./document.js";
import {carry, ratesOf} from "./motions.js";
import {lengthName, lengthUnit} from "./units.js";
import {button, make} from "./player/elements.js";
import {Painter, THEMES, contextOf} from "./player/painter.js";

const ROUNDING = 1e-10;  // relative to the scale of a quantity: values that vary less are constant
const FIRST_CURVES = 4;  // among which one that is not constant is looked for: those of a pin
const VIOLATION = "constraint violation";
const ONE_TURN = ", one turn";
const TOGETHER = [["x", "speed", "acceleration"], ["angle", "angular velocity", "angular acceleration"]];  // of a pin, and of a link

// The requests that each panel offers: subject, label of the button, tooltip.
const PANELS = {
  kinematics: {title: "Kinematics", words: "positions, speeds, angles, travel of motors", actions: []},
  dynamics: {title: "Dynamics", words: "energies, driving torques and forces, forces at pins",
    actions: [["dynamics", "Forces at pins", "compute forces at pins and the power of motors"]]},
  statics: {title: "Statics", words: "equilibrium, holding torques and forces",
    actions: [["rest", "Equilibrium", "find the stable equilibrium next to the drawn position, and its natural frequencies"],
      ["holding", "Holding torques", "compute the holding torques and forces of the motors at rest in each position of the motion, and the forces at pins"]]},
};

export class CurvesPanel {
  constructor(studio, element) {
    Object.assign(this, {studio, panel: "kinematics", chosen: {}, served: {}, facts: {}, busy: ""});
    this.tabs = Object.entries(PANELS).map(([name, {title, words}]) => [name, make("button", {type: "button", role: "tab", title: words, onclick: () => this.open(name)}, title)]);
    this.actions = Object.entries(PANELS).flatMap(([panel, {actions}]) => actions.map(([name, words, title]) => ({panel, name, button: button(words, title, () => this.ask(name), "action")})));
    this.select = make("select", {"aria-label": "curve", onchange: () => { this.chosen[this.panel] = this.select.value; this.isKept = true; studio.redraw(); }});
    this.over = make("select", {"aria-label": "over", title: "the horizontal axis", onchange: () => studio.redraw()});
    this.more = button("+", "keep this curve, and choose another one as well", () => this.keep());
    this.less = button("−", "show one curve alone", () => { this.keptNames[this.panel] = []; studio.redraw(); });
    this.all = button("x, v, a", "show position, speed and acceleration together", () => this.together());
    this.keptNames = {};
    this.canvas = make("canvas", {"aria-hidden": "true"});
    this.fact = make("span", {class: "fact", role: "status"});
    element.append(make("div", {class: "strip-bar"}, make("div", {class: "tabs", role: "tablist", "aria-label": "curves of"}, ...this.tabs.map(([, tab]) => tab)),
      this.select, this.more, this.all, this.less, this.over, ...this.actions.map(one => one.button), this.fact), this.canvas);
    this.canvas.addEventListener("pointerdown", event => { this.canvas.setPointerCapture(event.pointerId); this.seek(event); });
    this.canvas.addEventListener("pointermove", event => { if (event.buttons) this.seek(event); });
    this.open(this.panel);
  }

  open(panel) {
    this.panel = panel;
    for (const [name, tab] of this.tabs) tab.setAttribute("aria-selected", name === panel);
    this.listed = null;
    this.studio.redraw();
  }

  /** The curves that are shown beside the chosen one. */
  kept() { return this.keptNames[this.panel] ?? []; }

  keep() {
    this.keptNames[this.panel] = [...new Set([...this.kept(), this.name])];
    this.isKept = true;
    this.select.focus();
    this.studio.redraw();
  }

  /** The position, speed and acceleration of the pin or link whose curve is chosen. */
  three() {
    const at = this.name.lastIndexOf(": "), names = this.names(), quantity = this.name.slice(at + 2);
    const found = TOGETHER.map(three => three.map(one => `${this.name.slice(0, at)}: ${one}`)).filter(three => at > 0 && three.every(one => names.includes(one)));
    return found.find((_, k) => found.length === 1 || TOGETHER[k].includes(quantity)) ?? [];
  }

  together() {
    const found = this.three();
    if (!found.length) return;
    this.keptNames[this.panel] = found.slice(0, -1);
    this.chosen[this.panel] = this.select.value = found.at(-1);
    this.isKept = true;
    this.studio.redraw();
  }

  get name() { return this.chosen[this.panel] ?? ""; }

  seek(event) {
    const box = this.canvas.getBoundingClientRect(), {motion} = this.studio;
    motion.pause();
    if (!motion.end || !this.along) return;
    motion.seek(this.along.timeOf(valueAt(event.clientX - box.left, box.width, this.along.range, this.cache.curves)));
  }

  /** The names of the curves of the panel that is open. */
  names() {
    const {motion} = this.studio;
    if (!motion.run || motion.run.count < 2) return [];
    const own = {kinematics: () => this.kinematic(), dynamics: () => this.dynamic(), statics: () => []}[this.panel]();
    return [...own, ...this.servedCurves().map(shownName).filter(name => !own.includes(name))];
  }

  kinematic() {
    const {document, motion} = this.studio, accelerations = Boolean(motion.energies?.a), found = [], driven = list(document, "motor").flatMap(({pin}) => (pin ? members(document, pin) : []));
    for (const pin of Object.keys(pinsOf(document))) {
      if (this.studio.canvas.carrier(document, pin) >= 0) found.push(`${pin}: x`, `${pin}: y`, `${pin}: speed`, ...(accelerations ? [`${pin}: acceleration`] : []));
      const met = members(document, pin).filter(name => name !== "ground"), transmits = driven.length && !met.some(name => driven.includes(name));
      if (met.length === 2) found.push(`${pin}: angle between ${met[0]} and ${met[1]}${transmits ? " (transmission angle)" : ""}`);
    }
    for (const link of list(document, "link")) found.push(`${link.name}: angle`, `${link.name}: angular velocity`, ...(accelerations ? [`${link.name}: angular acceleration`] : []));
    return motion.run.violation.length ? [...found, VIOLATION] : found;
  }

  dynamic() {
    const {energies, pageEngine} = this.studio.motion;
    if (!energies || pageEngine.scene.massless.length) return [];
    const known = pageEngine.scene.drivers.filter(({name}) => energies.efforts[name]?.some(Number.isFinite));
    return [...known.map(({effort}) => effort), "kinetic energy", "potential energy", "energy"];
  }

  /** The links whose masses forces and energies would need. */
  lacking() { return (this.studio.motion.pageEngine?.scene.massless ?? []).join(", "); }

  /** The server's answer for the open panel, if it is about this drawing. */
  servedFor() {
    const found = this.served[this.panel];
    return found?.document === this.studio.document ? found : null;
  }

  servedCurves() { return this.servedFor()?.curves ?? []; }

  /** Show a curve of the selected element, if it has one, unless a curve was chosen from the list. */
  follow() {
    if (this.isKept && this.names().includes(this.name)) return;
    this.isKept = false;
    const first = this.firstOf(this.names().filter(name => name.startsWith(this.selectedName())));
    if (first && !this.name.startsWith(this.selectedName())) this.chosen[this.panel] = first;
    this.select.value = this.name;
  }

  /** The first of some curves, or, if it is constant, the first of the next ones that is not. */
  firstOf(names) {
    const varies = ({values}) => {
      const [low, high] = [Math.min, Math.max].map(end => values.reduce((found, x) => (Number.isFinite(x) ? end(found, x) : found), values[0]));
      return high - low > ROUNDING * (Math.abs(low) + Math.abs(high));
    };
    return names.slice(0, FIRST_CURVES).find(name => varies(this.values(name))) ?? names[0];
  }

  /** Offer the available curves. */
  list() {
    const names = this.names(), groups = names.filter(name => name.startsWith(this.selectedName()));
    if (!names.includes(this.name)) this.chosen[this.panel] = this.firstOf(groups) ?? this.firstOf(names) ?? "";
    this.select.replaceChildren(...names.map(name => make("option", {value: name}, name)));
    this.select.value = this.name;
    const motors = this.studio.motion.pageEngine && names.length ? turningMotors(this.studio.motion.pageEngine.scene).map(({name}) => name) : [], {value} = this.over;
    const axes = motors.flatMap(name => [[name, name], [`${name}${ONE_TURN}`, `${name}${ONE_TURN}`]]);
    this.over.replaceChildren(...[["", "time"], ...axes].map(([axis, words]) => make("option", {value: axis}, words)));
    this.over.value = axes.some(([axis]) => axis === value) ? value : "";
    this.over.hidden = !motors.length;
    this.select.hidden = this.more.hidden = !names.length;
    this.listed = names.join();
  }

  selectedName() {
    const [item] = this.studio.selection;
    return item ? `${item.kind === "pin" ? item.name : nameOf(this.studio.document, item.kind, item.index)}:` : "\0";
  }

  /** The values of a curve, and their unit. */
  values(name) {
    const {document, motion} = this.studio, {run, energies, pageEngine} = motion, {size} = pageEngine, unit = lengthUnit(document), long = lengthName(document);
    const served = this.servedCurves().find(curve => shownName(curve) === name);
    if (served && !(this.panel === "dynamics" && this.dynamic().includes(name))) return {unit: served.unit, ts: this.servedFor().times, values: served.values.map(x => x ?? NaN)};
    if (name === VIOLATION) return {unit: "", log: true, values: Array.from(run.violation, x => Math.max(x, 1e-17))};
    if (name === "energy") return {unit: "J", values: Array.from(energies.kinetic, (x, k) => x + energies.potential[k])};
    if (name.endsWith(" energy")) return {unit: "J", values: energies[name.split(" ")[0]]};
    const at = name.lastIndexOf(": "), owner = name.slice(0, at), quantity = name.slice(at + 2), link = list(document, "link").findIndex(l => l.name === owner);
    const driver = pageEngine.scene.drivers.find(({effort}) => effort === name);
    if (driver) return {unit: driver.unit, values: energies.efforts[driver.name]};
    const each = action => Array.from({length: run.count}, (_, i) => action(i * size, pageEngine.motions(run.q.slice(i * size, (i + 1) * size))));
    const still = (scale, values) => withoutRounding(values, scale);
    if (quantity === "angle" && link >= 0) return {unit: "°", values: still(180, each(i => run.q[i + 3 * pageEngine.order[link] + 2] * 180 / Math.PI))};
    if (quantity === "angular velocity") return {unit: "rad/s", values: each(i => run.v[i + 3 * pageEngine.order[link] + 2])};
    if (quantity === "angular acceleration") return {unit: "rad/s²", values: each(i => energies.a[i + 3 * pageEngine.order[link] + 2])};
    const place = placeOf(document, owner), carrier = this.studio.canvas.carrier(document, owner);
    if (quantity.startsWith("angle between ")) return {unit: "°", values: this.angles(owner, each)};
    if (quantity === "speed") return {unit: `${long}/s`, values: each((i, motions) => Math.hypot(...this.rates(i, motions, carrier, place).v) / unit)};
    if (quantity === "acceleration") return {unit: `${long}/s²`, values: each((i, motions) => Math.hypot(...this.rates(i, motions, carrier, place).a) / unit)};
    return {unit: long, values: still(pageEngine.scene.length / unit, each((_, motions) => carry(motions, carrier, place)[quantity === "x" ? 0 : 1] / unit))};
  }

  /** Velocity and acceleration (m/s, m/s2) of a place of a link at an instant, whose numbers begin at i. */
  rates(i, motions, link, place) {
    const {run, energies, pageEngine} = this.studio.motion, part = x => x && x.subarray(i, i + pageEngine.size);
    return ratesOf({q: part(run.q), v: part(run.v), a: part(energies?.a)}, pageEngine.order[link], carry(motions, link, place));
  }

  /** All curves of the motion as comma-separated values, in the units in which they are shown; empty without a motion. */
  table() {
    const {run} = this.studio.motion, {panel} = this;
    if (!run || run.count < 2) return "";
    const columns = [["time (s)", Array.from(run.ts).slice(0, run.count)]];
    for (const one of ["kinematics", "dynamics"]) {
      this.panel = one;
      for (const name of this.names()) {
        const {unit, values, ts} = this.values(name);
        if (!ts) columns.push([`${name}${unit && ` (${unit})`}`, values]);
      }
    }
    this.panel = panel;
    const cell = words => (/^[=+\-@\t]/.test(words) ? `"'${words.replaceAll('"', '""')}"` : /[",\n]/.test(words) ? `"${words.replaceAll('"', '""')}"` : words);
    return `${[columns.map(([name]) => cell(name)), ...columns[0][1].map((_, i) => columns.map(([, values]) => values[i]))].map(row => row.join(",")).join("\n")}\n`;
  }

  /** The angle (degrees, 0 to 180) at a pin between the lines to the farthest other pin of each of its two links. */
  angles(pin, each) {
    const {document} = this.studio, here = placeOf(document, pin), met = members(document, pin).filter(name => name !== "ground");
    const links = met.map(name => list(document, "link").findIndex(link => link.name === name));
    const ends = links.map(k => list(document, "link")[k].pins.map(name => placeOf(document, name)).sort((a, b) => Math.hypot(b[0] - here[0], b[1] - here[1]) - Math.hypot(a[0] - here[0], a[1] - here[1]))[0]);
    return each((_, motions) => {
      const at = carry(motions, links[0], here), [a, b] = ends.map((end, k) => { const p = carry(motions, links[k], end); return Math.atan2(p[1] - at[1], p[0] - at[0]); });
      const between = Math.abs((a - b) * 180 / Math.PI) % 360;
      return between > 180 ? 360 - between : between;
    });
  }

  /** Ask the server for the subject of a button. */
  async ask(about) {
    const {studio} = this, {document} = studio, {panel} = this;
    this.busy = about;
    this.facts[panel] = null;
    this.showBar();
    try {
      const found = await ask("diagnose", {text: await studio.files.text(), about});
      if (found.problems.length) throw new Error(found.problems.join("; "));
      if (about === "rest") this.showRest(found, document);
      else {
        this.served[panel] = {...found, document};
        this.chosen[panel] = found.curves.map(shownName).find(name => name.includes("force")) ?? this.name;
        this.listed = null;
      }
    } catch (error) { this.facts[panel] = {document, words: error.message, isBad: true}; }
    this.busy = "";
    studio.redraw();
  }

  showRest({q, kind, frequencies}, document) {
    if (document === this.studio.document && q) this.studio.motion.pose(Float64Array.from(q));
    const rates = frequencies.map(x => `${+x.toPrecision(4)} Hz`).join(", ");
    this.facts.statics = {document, words: q ? `${kind} equilibrium${rates ? `, natural frequencies ${rates}` : ""}` : "no equilibrium was found"};
  }

  /** The buttons of the open panel, and its status text. */
  showBar() {
    const {studio} = this, {motion} = studio, moves = motion.run?.count > 1, fact = this.facts[this.panel];
    for (const {panel, name, button} of this.actions) {
      button.hidden = panel !== this.panel || !motion.run || (!moves && name !== "rest") || Boolean(this.lacking());
      button.disabled = Boolean(this.busy);
    }
    this.less.hidden = !this.kept().length;
    this.all.hidden = !this.three().length;
    const said = fact?.document === studio.document ? fact : null;
    const words = this.busy ? "computing …" : said?.words ?? (this.panel === "kinematics" && moves ? studio.findings.travelWords() : "");
    if (this.fact.textContent !== words) this.fact.textContent = this.fact.title = words;
    this.fact.classList.toggle("bad", Boolean(said?.isBad));
  }

  draw() {
    const {studio, canvas} = this, {motion} = studio;
    if (!canvas.clientWidth || !canvas.clientHeight) return undefined;
    if (this.names().join() !== this.listed) this.list();
    this.showBar();
    const {context, width, height} = contextOf(canvas), theme = THEMES[studio.theme];
    if (!this.name || !motion.run || motion.run.count < 2) return this.drawNothing(context, theme, width, height);
    const names = [...new Set([...this.kept().filter(name => this.names().includes(name)), this.name])], key = [names.join("\n"), this.panel, motion.run, this.served[this.panel], this.over.value];
    if (!this.cache || key.some((x, k) => x !== this.cache.key[k])) {
      const {value} = this.over, isTurn = value.endsWith(ONE_TURN);
      this.along = alongOf(motion.run, motion.pageEngine.scene, isTurn ? value.slice(0, -ONE_TURN.length) : value, isTurn);
      this.cache = {key, curves: names.map(name => ({name, ...this.values(name)}))};
    }
    const {along} = this, {curves} = this.cache, now = values => along.between(values, motion.t);
    return drawChart(context, width, height, curves.map(curve => ({...curve, now: now(curve.values)})), {...along, now: along.at(motion.t)}, theme, curves[0].log, canvas.offsetTop === 0);
  }

  drawNothing(context, theme, width, height) {
    const moves = this.studio.motion.run?.count > 1;
    const lacking = this.panel !== "kinematics" && this.lacking();
    const words = lacking ? `No mass of ${lacking}: give each a mass, or a density with a thickness.` : moves ? "Press a button above to compute curves." : "Curves appear here once the mechanism moves.";
    new Painter(context, {x: 0, y: 0, scale: 1}, theme, 1, null).text(words, [width / 2, height / 2], theme.soft, {align: "center", halo: false});
  }
}

const shownName = curve => `${curve.name}${curve.unique ? "" : " (not unique)"}`;

/** The values, or all equal to the first one if they differ only by rounding. */
function withoutRounding(values, scale) {
  const spread = values.reduce((most, x) => Math.max(most, Math.abs(x - values[0])), 0);
  return spread <= ROUNDING * scale ? values.map(() => values[0]) : values;
}
