// Findings about the drawing, always in view: mistakes; degrees of freedom; redundant constraints and their fixes; what moves the
// mechanism, or why it cannot move; which reactions are unique; the travel of motors.

import {list, nameOf, LISTS, pinsOf} from "./document.js";
import {loosePins} from "./joining.js";
import {thinPlates} from "./shapes.js";
import {make} from "./player/elements.js";

const COMPONENTS = ["x", "y", "torque"];
const MOST_PROBLEMS = 30, MOST_LOOSE = 6;
const HINTS = {
  freedom: "independent motions that the joints leave",
  redundant: "a constraint that the others imply already: removing it changes no motion, and makes reactions unique",
};

export class FindingsPanel {
  constructor(studio, element) {
    Object.assign(this, {studio, element, travel: null, structure: null});
  }

  /** Fade the findings: they describe an earlier drawing until new ones arrive. */
  markStale() { this.element.classList.add("stale"); }

  /** Show new contents, for the current drawing. */
  replace(...rows) {
    this.element.classList.remove("stale");
    this.element.replaceChildren(...rows);
  }

  showFailure(words) {
    this.structure = this.travel = null;
    this.mark([]);
    this.replace(make("p", {class: "lead bad"}, "The drawing could not be checked"), make("p", {}, words));
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
      make("p", {}, "As you draw, this panel shows the degrees of freedom, the redundant constraints, and what moves the mechanism or prevents it from moving."));
  }

  /** Show mistakes in the words of the file reader; a click on one selects its element. */
  showProblems(problems) {
    if (!problems.length) return;
    this.structure = this.travel = null;
    this.mark([]);
    this.replace(make("p", {class: "lead"}, `${plural(problems.length, "problem")} to solve before it can move`), ...this.loose(), make("p", {}, "Click a line to go to the element."),
      make("ul", {class: "problems"}, ...problems.slice(0, MOST_PROBLEMS).map(problem => {
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
    const {structure: s} = this, pins = pinsOf(this.studio.document);
    if (!s) return;
    const driven = s.joint_mobility !== s.degrees_of_freedom ? `, ${s.degrees_of_freedom} with motors held` : "";
    const rows = [make("p", {class: "lead"}, make("b", {title: HINTS.freedom}, `${s.joint_mobility} ${s.joint_mobility === 1 ? "degree" : "degrees"} of freedom`), driven, " · ",
      make("b", {class: s.redundant ? "bad" : "", title: HINTS.redundant}, s.redundant ? plural(s.redundant, "redundant constraint") : "no redundant constraints")),
    s.conflict ? make("p", {class: "warn"}, s.conflict) : make("p", {}, s.motion, "."), ...(s.singular ? [make("p", {class: "warn"}, "The drawn position is singular: either branches of the motion meet here, or the mechanism moves only infinitesimally.")] : [])];
    for (const one of this.travel ?? []) rows.push(make("p", {class: one.ends.length || one.lost.length ? "warn" : ""}, travelWords(one)));
    rows.push(...this.loose(), ...thinPlates(this.studio.document).map(words => make("p", {class: "warn"}, words)));
    for (const set of s.sets) rows.push(this.set(set, pins));
    const shared = Object.entries(s.not_unique);
    rows.push(make("p", {}, make("b", {}, "Reactions: "), shared.length
      ? `not unique at ${shared.map(([name, {components}]) => `${name} (${components.flatMap((isUnique, k) => (isUnique ? [] : [COMPONENTS[k] ?? k])).join(", ")})`).join(", ")}: how these forces are shared depends on the stiffness of the parts`
      : "all unique"));
    rows.push(make("details", {class: "more"}, make("summary", {}, "Full diagnosis"), make("pre", {}, s.text)));
    const again = this.element.querySelector("details.more")?.open;
    this.replace(...rows);
    this.element.querySelector("details.more").open = Boolean(again);
    this.mark(s.sets.flatMap(set => set.constraints.map(pinOf(pins)).filter(Boolean).map(pin => [pin, {sign: "R", strong: false}])));
  }

  /** Pins that look joined to a bar and are not, each with a button that joins them. */
  loose() {
    const {studio} = this;
    return loosePins(studio.document).slice(0, MOST_LOOSE).map(one => make("p", {class: "warn"}, `pin ${one.pin} lies on ${nameOf(studio.document, "link", one.link)} but does not belong to it `,
      make("button", {type: "button", class: "small", "aria-label": `join ${one.pin} to ${nameOf(studio.document, "link", one.link)}`, onclick: () => studio.join(one)}, "Join")));
  }

  /** The travel of motors, in words; empty until it is known for the current drawing. */
  travelWords() {
    if (!this.travel || this.element.classList.contains("stale")) return "";
    return this.travel.map(travelWords).join(" ");
  }

  /** A button that applies a fix, if the drawing can express it. */
  fixButton({constraint, document}) {
    const {studio} = this, isStale = () => this.element.classList.contains("stale");
    return document ? [make("button", {type: "button", class: "small", "aria-label": `apply the change at ${constraint}`,
      onclick: () => (isStale() ? studio.say("the drawing has changed: wait for its new findings") : studio.commit(document, []))}, "Apply")] : [];
  }

  set({constraints, count, permanent, fixes}, pins) {
    const toPin = pinOf(pins), names = constraints.join(", "), it = count === 1 ? "it" : "at least one of them";
    return make("div", {class: "set"},
      make("p", {}, make("b", {class: "bad"}, "R "), `${names}: ${plural(count, "redundant constraint")} in ${permanent ? "every position" : "this position only"}.`,
        fixes.length ? ` Any one of these changes removes ${it}:` : permanent ? ` No change of a single joint was found that removes ${it}.` : ""),
      make("ul", {}, ...fixes.map(fix => make("li", {}, make("button", {type: "button", class: "link",
        onclick: () => this.studio.select([itemNamed(this.studio.document, fix.constraint)].filter(Boolean)),
        onmouseenter: () => this.mark([...constraints.map(toPin).filter(Boolean).map(pin => [pin, {sign: "R", strong: pin === toPin(fix.constraint)}])]),
      }, make("b", {}, fix.constraint), `: ${fix.change}`), ...this.fixButton(fix)))));
  }
}

const plural = (n, word) => `${n} ${word}${n === 1 ? "" : "s"}`;

const pinOf = pins => name => (Object.hasOwn(pins, name) ? name : Object.keys(pins).find(pin => name.startsWith(`${pin}-`)));

function travelWords({motor, unit, words, ends, lost}) {
  const value = x => (unit === "rad" ? `${(x * 180 / Math.PI).toFixed(1)}°` : `${+(1e3 * x).toPrecision(4)} mm`).replace("-", "−");
  const unknown = lost.length ? ` Its ${lost.join(" and ")} limit${lost.length > 1 ? "s" : ""} could not be found.` : "";
  if (!ends.length) return unknown ? `${motor}:${unknown.toLowerCase()}` : `${motor} ${unit === "rad" ? "turns all the way round" : "has no limits"}.`;
  const line = triples => (triples.length ? ` (${triples.map(names => names.join(", ")).join("; ")} in line)` : "");
  return `${motor} stops at ${ends.map(end => value(end.value) + line(end.in_line)).join(" and at ")}: ${words}.${unknown}`;
}

/** The pin or element of a constraint, by its name; undefined if there is none. */
function itemNamed(document, name) {
  const pin = pinOf(pinsOf(document))(name);
  if (pin !== undefined) return {kind: "pin", name: pin};
  return ["slide", "slot", "gear", "cam", "motor", "joint", "driver"].flatMap(kind => list(document, kind).map((_, index) => ({kind, index})))
    .find(({kind, index}) => nameOf(document, kind, index) === name);
}

/** The element of a mistake; null if it names none. */
function itemOf(document, problem) {
  const pin = /^pins\.([^:]+?)(?:\[\d+\])?:/.exec(problem)?.[1];
  if (pin !== undefined && Object.hasOwn(pinsOf(document), pin)) return {kind: "pin", name: pin};
  const found = /\(([a-z]+)\[(\d+)\]\)/.exec(problem);
  if (!found || !LISTS.includes(found[1]) || +found[2] >= list(document, found[1]).length) return null;
  return nameOf(document, found[1], +found[2]) === undefined ? null : {kind: found[1], index: +found[2]};
}
