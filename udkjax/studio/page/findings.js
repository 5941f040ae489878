// What is found about the drawing, always in view: mistakes; freedoms; redundant constraints with what frees them; what moves it or
// why nothing does; which reactions are unique; how far motors turn.

import {list, nameOf, LISTS, pinsOf} from "./document.js";
import {applyFix} from "./fixes.js";
import {make} from "./player/elements.js";

const COMPONENTS = ["x", "y", "torque"];

export class FindingsPanel {
  constructor(studio, element) {
    Object.assign(this, {studio, element, travel: null, structure: null});
  }

  /** What stands here is of an earlier drawing, until it is looked at anew. */
  markStale() { this.element.classList.add("stale"); }

  /** Show other contents, which are of this drawing. */
  replace(...rows) {
    this.element.classList.remove("stale");
    this.element.replaceChildren(...rows);
  }

  showFailure(words) {
    this.structure = this.travel = null;
    this.mark([]);
    this.replace(make("p", {class: "lead bad"}, "The studio could not look at it"), make("p", {}, words));
    this.studio.say(words, true);
  }

  mark(entries) {
    this.studio.marked = new Map(entries);
    this.studio.redraw();
  }

  showEmpty() {
    this.structure = this.travel = null;
    this.mark([]);
    this.replace(
      make("p", {class: "lead"}, "Nothing is drawn yet"),
      make("p", {}, "Freedoms, redundant constraints and what moves the mechanism are said here while you draw."));
  }

  /** Mistakes, as the reader of files names them; each leads to its element. */
  showProblems(problems) {
    if (!problems.length) return;
    this.structure = this.travel = null;
    this.mark([]);
    this.replace(make("p", {class: "lead"}, problems.length === 1 ? "One thing is missing before it can move" : `${problems.length} things are missing before it can move`),
      make("ul", {class: "problems"}, ...problems.slice(0, 30).map(problem => {
        const item = itemOf(this.studio.document, problem);
        return make("li", {}, item ? make("button", {type: "button", class: "link", onclick: () => this.studio.select([item])}, problem) : problem);
      })));
  }

  showStructure(found) {
    if (found.problems.length) return this.showProblems(found.problems);
    this.structure = found;
    this.travel = null;
    return this.show();
  }

  showTravel(found) {
    this.travel = found.travel ?? [];
    this.show();
    this.studio.redraw();
  }

  show() {
    const {structure: s} = this, pins = pinsOf(this.studio.document), plural = (n, word) => `${n} ${word}${n === 1 ? "" : "s"}`;
    if (!s) return;
    const driven = s.joint_freedoms !== s.freedoms ? `, ${s.freedoms} with its motors held` : "";
    const rows = [make("p", {class: "lead"}, make("b", {}, plural(s.joint_freedoms, "freedom")), driven, " · ",
      make("b", {class: s.redundant ? "bad" : ""}, s.redundant ? plural(s.redundant, "redundant constraint") : "nothing redundant")),
    make("p", {}, s.motion, "."), ...(s.singular ? [make("p", {class: "warn"}, "It stands in a singular position: branches of its motion meet here, or it gives way to first order only.")] : [])];
    for (const one of this.travel ?? []) rows.push(make("p", {class: one.ends.length || one.lost.length ? "warn" : ""}, travelWords(one)));
    for (const set of s.sets) rows.push(this.set(set, pins));
    const loose = Object.entries(s.loose);
    rows.push(make("p", {}, make("b", {}, "Reactions: "), loose.length
      ? `not unique at ${loose.map(([name, {components}]) => `${name} (${components.flatMap((known, k) => (known ? [] : [COMPONENTS[k] ?? k])).join(", ")})`).join(", ")}: redundant constraints share them as their stiffness decides`
      : "all unique"));
    rows.push(make("details", {class: "more"}, make("summary", {}, "The diagnosis in full"), make("pre", {}, s.text)));
    const again = this.element.querySelector("details.more")?.open;
    this.replace(...rows);
    this.element.querySelector("details.more").open = Boolean(again);
    this.mark(s.sets.flatMap(set => set.constraints.map(pinOf(pins)).filter(Boolean).map(pin => [pin, {sign: "R", strong: false}])));
  }

  /** How far motors turn, in words; nothing while it is not known of this drawing. */
  travelWords() {
    if (!this.travel || this.element.classList.contains("stale")) return "";
    return this.travel.map(travelWords).join(" ");
  }

  /** A button that makes a fix, where the drawing has something for it. */
  freeing(fix) {
    const {studio} = this, {mover} = studio.motion, changed = () => applyFix(studio.document, fix, mover.bodies());
    const isStale = () => this.element.classList.contains("stale");
    return mover && changed() ? [make("button", {type: "button", class: "small", "aria-label": `free ${fix.constraint}`,
      onclick: () => (isStale() ? studio.say("the drawing has changed: wait until it is looked at anew") : studio.commit(changed(), []))}, "Do it")] : [];
  }

  set({constraints, count, permanent, fixes}, pins) {
    const toPin = pinOf(pins), names = constraints.join(", ");
    return make("div", {class: "set"},
      make("p", {}, make("b", {class: "bad"}, "R "), `${names}: ${count} redundant row${count === 1 ? "" : "s"}, ${permanent ? "everywhere" : "in this position only"}.`,
        fixes.length ? " One of these mends it:" : permanent ? " No single change of a joint was found that mends it." : ""),
      make("ul", {}, ...fixes.map(fix => make("li", {}, make("button", {type: "button", class: "link",
        onclick: () => this.studio.select([itemNamed(this.studio.document, fix.constraint)].filter(Boolean)),
        onmouseenter: () => this.mark([...constraints.map(toPin).filter(Boolean).map(pin => [pin, {sign: "R", strong: pin === toPin(fix.constraint)}])]),
      }, make("b", {}, fix.constraint), `: ${changeWords(fix)}`), ...this.freeing(fix)))));
  }
}

const pinOf = pins => name => (Object.hasOwn(pins, name) ? name : Object.keys(pins).find(pin => name.startsWith(`${pin}-`)));

function changeWords({change, drawn}) {
  const of = name => (name === "ground" ? "the ground" : name);
  return drawn?.kind === "slot" ? `make it a slot of ${of(drawn.on)} that guides the pin of ${of(drawn.link)}` : change;
}

function travelWords({motor, unit, ends, lost}) {
  const value = x => (unit === "rad" ? `${(x * 180 / Math.PI).toFixed(1)}°` : `${+(1e3 * x).toPrecision(4)} mm`).replace("-", "−");
  const unknown = lost.length ? ` How far it goes ${lost.join(" and ")} could not be found.` : "";
  if (!ends.length) return unknown ? `${motor}:${unknown.toLowerCase()}` : `${motor} ${unit === "rad" ? "turns all the way round" : "has no limits"}.`;
  const line = triples => (triples.length ? `: ${triples.map(names => names.join(", ")).join("; ")} in line` : "");
  return `${motor} stops at ${ends.map(end => value(end.value) + line(end.in_line)).join(", and at ")}.${unknown}`;
}

/** The pin or the element that a constraint is of, by its name; undefined where there is none. */
function itemNamed(document, name) {
  const pin = pinOf(pinsOf(document))(name);
  if (pin !== undefined) return {kind: "pin", name: pin};
  return ["slide", "slot", "gear", "cam", "motor", "joint", "driver"].flatMap(kind => list(document, kind).map((_, index) => ({kind, index})))
    .find(({kind, index}) => nameOf(document, kind, index) === name);
}

/** The element that a mistake is about. */
function itemOf(document, problem) {
  const pin = /^pins\.([^:]+?)(?:\[\d+\])?:/.exec(problem)?.[1];
  if (pin !== undefined && Object.hasOwn(pinsOf(document), pin)) return {kind: "pin", name: pin};
  const found = /\(([a-z]+)\[(\d+)\]\)/.exec(problem);
  if (!found || !LISTS.includes(found[1]) || +found[2] >= list(document, found[1]).length) return null;
  return nameOf(document, found[1], +found[2]) === undefined ? null : {kind: found[1], index: +found[2]};
}
