// The laws of lift of a cam as fields, a row for each segment. Every change leaves a whole turn, and a follower that comes back.

import {LAWS, followerDistance} from "./shapes.js";
import {list, members, shiftPins, withKey} from "./document.js";
import {angle, angleWritten, direction, length, unitVector, written} from "./units.js";
import {readValue, valueText} from "./values.js";
import {make} from "./player/elements.js";

const FIRST = {law: ["cycloidal", "dwell", "cycloidal", "dwell"], share: [120, 60, 120, 60], step: [1, 0, -1, 0]};  // of a new profile by laws

const ROUNDS = 6, STEP = 1e-4, SAME = 1e-9;  // of Newton's method for the place of a follower; its step and error as shares of the base

const stepKey = profile => (profile.swing ? "swing" : "lift");
const stepOf = (profile, value, document) => (profile.swing ? angle : length)(value, document);
const stepWritten = (profile, ...given) => (profile.swing ? angleWritten : written)(...given);

/** The segments {law, angle, step} of a profile by laws, with the values of the file; null if it has none, or not all numbers. */
export function segmentsOf(profile, document) {
  const {law, angle: turns, [stepKey(profile ?? {})]: steps} = profile ?? {};
  if (![law, turns, steps].every(x => Array.isArray(x) && x.length === law.length)) return null;
  const found = law.map((name, k) => ({law: name, angle: turns[k], step: steps[k]}));
  return found.every(one => Number.isFinite(angle(one.angle, document)) && Number.isFinite(stepOf(profile, one.step, document))) ? found : null;
}

const profileOf = (profile, segments) => ({...profile, law: segments.map(one => one.law), angle: segments.map(one => one.angle), [stepKey(profile)]: segments.map(one => one.step)});

/** The neighbour of a segment that makes up for a change of its angle. */
const neighbour = (segments, k) => (k + 1 < segments.length ? k + 1 : k - 1);

/** The profile with another angle (rad) of a segment, for which its neighbour makes up; null if that has no room. */
export function withAngle(profile, k, radians, document) {
  const found = segmentsOf(profile, document), other = neighbour(found, k);
  const rest = other < 0 ? NaN : angle(found[other].angle, document) - radians + angle(found[k].angle, document);
  if (!(radians > 0 && rest > 0)) return null;
  const put = (one, value) => ({...one, angle: angleWritten(value, document, one.angle)});
  return profileOf(profile, found.with(k, put(found[k], radians)).with(other, put(found[other], rest)));
}

/** The profile with another lift (m) or swing (rad) of a segment, for which the next one that moves makes up; null if none does. */
export function withStep(profile, k, step, document) {
  const found = segmentsOf(profile, document), change = step - stepOf(profile, found[k].step, document);
  const after = [...found.keys()].map(i => (k + 1 + i) % found.length), other = after.find(i => i !== k && found[i].law !== "dwell");
  if (change === 0) return profile;
  if (other === undefined || (found[k].law === "dwell" && step !== 0)) return null;
  const put = (one, value) => ({...one, step: stepWritten(profile, value, document, one.step)});
  return profileOf(profile, found.with(k, put(found[k], step)).with(other, put(found[other], stepOf(profile, found[other].step, document) - change)));
}

/** The profile with another law of a segment; a dwell has no lift. */
export function withLaw(profile, k, law, document) {
  const still = law === "dwell" ? withStep(profile, k, 0, document) : profile;
  return still && profileOf(still, segmentsOf(still, document).map((one, i) => (i === k ? {...one, law} : one)));
}

/** The profile whose last segment is followed by a dwell, which takes half of its angle. */
export function withSegment(profile, document) {
  const found = segmentsOf(profile, document), last = found.at(-1), half = angleWritten(angle(last.angle, document) / 2, document, last.angle);
  const dwell = {law: "dwell", angle: half, step: stepWritten(profile, 0, document, last.step)};
  return profileOf(profile, [...found.slice(0, -1), {...last, angle: half}, dwell]);
}

/** The profile without a segment, whose angle goes to its neighbour; null if it is the last one, or nothing takes its lift. */
export function withoutSegment(profile, k, document) {
  const still = withStep(profile, k, 0, document), found = still && segmentsOf(still, document);
  if (!found || found.length < 2) return null;
  const other = neighbour(found, k), both = angle(found[other].angle, document) + angle(found[k].angle, document);
  return profileOf(still, found.with(other, {...found[other], angle: angleWritten(both, document, found[other].angle)}).toSpliced(k, 1));
}

/** A profile by laws in place of one by points: as high, with the follower as drawn on its base circle. */
export function profileByLaws(document, cam) {
  const radii = (cam.profile?.radius ?? []).map(x => length(x, document)), base = followerDistance(document, cam);
  const lift = radii.length ? Math.max(...radii) - Math.min(...radii) : NaN;
  if (!(base > 0 && lift > 0)) return null;
  const turn = k => angleWritten(FIRST.share[k] * Math.PI / 180, document), step = k => written(FIRST.step[k] * lift, document);
  return {base: written(base, document), law: FIRST.law, angle: FIRST.law.map((_, k) => turn(k)), lift: FIRST.law.map((_, k) => step(k))};
}

/** The drawing with another base of a cam; a follower that a slide of the ground guides moves along it until it stands on the base. */
export function withBase(document, index, value) {
  const cam = list(document, "cam")[index], found = withKey(document, "cam", index, "profile", {...cam.profile, base: value}), base = length(value, document);
  const link = list(document, "link").find(({pins = []}) => pins.includes(cam.pins?.[1])), slide = list(document, "slide").find(one => one.link === link?.name && !one.on);
  const turn = slide?.direction === undefined ? NaN : direction(slide.direction, document), [ex, ey] = unitVector(turn);
  if (!(base > 0) || !Number.isFinite(turn) || link.pins.some(pin => members(document, pin).length > 1)) return found;
  const at = way => shiftPins(found, link.pins, way * ex, way * ey), off = way => followerDistance(at(way), cam) - base, step = STEP * base;
  let way = 0;
  for (let k = 0; k < ROUNDS; k++) way -= off(way) * 2 * step / (off(way + step) - off(way - step));
  return Math.abs(off(way)) <= SAME * base ? at(way) : found;
}

/** The fields of the profile of a cam by laws, or a choice of laws for one by points; `panel` shows them. */
export function camFields(panel, cam, index, units) {
  const {studio: {document}} = panel, {profile = {}} = cam, segments = segmentsOf(profile, document);
  const takeBase = value => (length(value, document) > 0 ? panel.set(withBase(document, index, value)) : panel.refuse("the base is a length above 0: write 40 or 40 mm"));
  const put = (next, why) => (next ? panel.set(withKey(document, "cam", index, "profile", next)) : panel.refuse(why));
  if (!segments) {
    if (profile.law) return [panel.field("profile", valueText(profile), "", text => put(readValue(text)))];  // lists of different lengths
    const laws = profileByLaws(document, cam);
    return laws ? [panel.choice("profile", "given by …", [["laws of lift", "laws"]], () => put(laws), "given by")] : [];
  }
  const number = (words, value, read, change, why) => {
    const input = make("input", {type: "text", value: valueText(value), "aria-label": words, title: words, spellcheck: "false"});
    input.addEventListener("change", () => {
      const found = read(panel.read(input.value.trim(), words.startsWith("angle") ? "angle" : units.step));
      return Number.isFinite(found) ? put(change(found), why) : panel.refuse(`"${input.value}" is not a number with a unit`);
    });
    return input;
  };
  const rows = segments.map((one, k) => {
    const law = make("select", {"aria-label": `law ${k + 1}`}, ...Object.keys(LAWS).map(name => make("option", {value: name}, name)));
    law.value = one.law;
    law.addEventListener("change", () => put(withLaw(profile, k, law.value, document), "no other segment moves, which could take the lift"));
    const turn = number(`angle ${k + 1}`, one.angle, x => angle(x, document), x => withAngle(profile, k, x, document), "its neighbour would have no angle left");
    const step = number(`${stepKey(profile)} ${k + 1}`, one.step, x => stepOf(profile, x, document), x => withStep(profile, k, x, document),
      one.law === "dwell" ? "a dwell has no lift: choose another law" : "no other segment moves, which could bring the follower back");
    step.disabled = one.law === "dwell";
    const away = make("button", {type: "button", class: "icon", "aria-label": `remove segment ${k + 1}`, title: "remove this segment",
      onclick: () => put(withoutSegment(profile, k, document), "no other segment could take its angle and its lift")}, "×");
    return make("div", {class: "segment"}, law, turn, step, away);
  });
  const head = make("div", {class: "segment head"}, make("span", {}, "law"), make("span", {}, `angle ${units.angle}`), make("span", {}, `${stepKey(profile)} ${units[units.step]}`));
  const base = panel.field("base", valueText(profile.base), units.length, text => takeBase(panel.read(text, "length")), "");
  return [base, head, ...rows, make("button", {type: "button", class: "small", onclick: () => put(withSegment(profile, document))}, "Add a segment")];
}
