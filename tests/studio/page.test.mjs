// The modules of the studio's page that need no browser: run by `node --test` (tests/studio/test_page_modules.py).

import assert from "node:assert/strict";
import {test} from "node:test";

const page = name => import(`${process.env.STUDIO_PAGE}/${name}.js`);
const d = await page("document"), actions = await page("actions"), {History} = await page("history"), units = await page("units");
const {valueText, readValue} = await page("values"), view = await page("view"), picking = await page("picking"), shapes = await page("shapes");
const clipboard = await page("clipboard"), forms = await page("pin_forms"), joining = await page("joining"), {evaluate} = await page("expressions");
const {bars, withBar, withTypedBar} = await page("dimensions"), {marksOf} = await page("dimension_marks"), {shapeProblem} = await page("checks"), cams = await page("cam_fields");
const {symbolsOf} = await page("drawn_symbols"), {motionsOf, carry} = await page("motions"), {stateAt} = await page("player/motion"), {TOOLS} = await page("tools");
const chart = await page("chart"), {alongOf} = await page("along");

const context = {size: 0.01, scale: 1000};
const at = (x, y, pin = null, link = null) => ({place: [x, y], pin, link, pixel: [1000 * x, -1000 * y]});
const freeze = value => {
  if (value && typeof value === "object") Object.values(Object.freeze(value)).forEach(freeze);
  return value;
};

/** A four-bar in millimetres, frozen: no action may change it. */
function fourBar() {
  let found = freeze(d.EMPTY);
  for (const [a, b] of [[at(0, 0), at(0.03, 0.04)], [at(0.03, 0.04, "B"), at(0.12, 0.09)], [at(0.1, 0), at(0.12, 0.09, "C")]]) found = freeze(actions.drawLink(found, a, b, context).document);
  for (const pin of ["A", "D"]) found = freeze(actions.drawGround(found, at(0, 0, pin)).document);
  return freeze(actions.drawMotor(found, at(0, 0, "A")).document);
}

test("links share pins, and are written in the file's unit", () => {
  const found = fourBar();
  assert.deepEqual(found.pins, {A: [0, 0], B: [30, 40], C: [120, 90], D: [100, 0]});
  assert.deepEqual(found.link.map(link => link.pins), [["A", "B"], ["B", "C"], ["D", "C"]]);
  assert.deepEqual(found.ground, ["A", "D"]);
  assert.deepEqual(found.motor, [{pin: "A", speed: "60 rpm"}]);
  assert.deepEqual(d.members(found, "A"), ["ground", "link1"]);
});

/** The same four-bar by lengths and angles, with a coupler point. */
function byLengths() {
  const found = fourBar(), pins = {C: {from: ["B", "D"], length: [120, 80], side: "left"}, P: {from: "B", length: "5 cm", angle: 30, line: ["B", "C"]}, A: [0, 0],
    B: {from: "A", length: 40, angle: 60}, D: {from: "A", along: [3, 0], length: 100}, M: {from: "B", to: "C", share: 0.5, off: 10}};
  return freeze({...found, pins, link: found.link.map((link, k) => (k === 1 ? {...link, pins: ["B", "C", "P", "M"]} : link))});
}
const near = (a, b) => a.forEach((x, k) => assert.ok(Math.abs(x - b[k]) < 1e-9, `${a} is not ${b}`));

test("pins by lengths and angles have places", () => {
  const found = byLengths(), place = name => d.placeOf(found, name).map(x => 1000 * x), apart = (a, b) => Math.hypot(place(a)[0] - place(b)[0], place(a)[1] - place(b)[1]);
  near(place("B"), [20, 20 * Math.sqrt(3)]);
  near(place("D"), [100, 0]);
  near([apart("B", "C"), apart("C", "D"), apart("B", "P")], [120, 80, 50]);
  const [b, c] = [place("B"), place("C")], axis = [(c[0] - b[0]) / 120, (c[1] - b[1]) / 120];
  near(place("M"), [(b[0] + c[0]) / 2 - 10 * axis[1], (b[1] + c[1]) / 2 + 10 * axis[0]]);
});

test("moving a pin changes the numbers of its form", () => {
  const found = byLengths(), at = name => d.placeOf(found, name);
  const moved = d.movePin(found, "B", [0.03, 0.04]);
  near([moved.pins.B.length, moved.pins.B.angle], [50, Math.atan2(4, 3) * 180 / Math.PI]);
  assert.equal(moved.pins.C, found.pins.C);  // the coupler and the rocker keep their lengths
  const across = d.movePin(found, "C", [0.06, -0.05]).pins.C;
  assert.equal(across.side, "right");
  near(across.length, [Math.hypot(40, 50 + 20 * Math.sqrt(3)), Math.hypot(40, 50)]);
  assert.equal(d.movePin(found, "P", at("P")).pins.P.length, "5 cm");
  assert.deepEqual(d.movePin(found, "M", at("M")).pins.M, found.pins.M);
  assert.deepEqual(d.movePin(found, "D", [0.09, 0.02]).pins.D, {from: "A", along: [3, 0], length: 90});
  assert.equal(d.movePin(found, "B", [-0.3, 0]), found);  // the circles would not meet
  const all = d.shiftPins(found, ["M", "C", "B", "A", "D", "P"], 0.01, 0.02);
  assert.deepEqual(all.pins, {...found.pins, A: [10, 20]});
});

test("a pin on a rail stays on it", () => {
  const found = freeze({...d.EMPTY, pins: {O: [0, 0], A: {from: "O", length: 50, angle: 60}, P: {from: "A", length: 200, on: "O", along: [2, 0]}}});
  near(d.placeOf(found, "P"), [0.025 + Math.sqrt(0.04 - 0.001875), 0]);
  const moved = d.movePin(found, "P", [0.1, 0.05]);
  near(d.placeOf(moved, "P"), [0.1, 0]);
  near(d.placeOf(d.movePin(found, "P", [-0.1, 0.05]), "P"), [-0.1, 0]);
  assert.equal(d.movePin(found, "A", [0, 0.3]), found);  // the rod does not reach the rail
  assert.equal(d.renamePin(found, "O", "X").pins.P.on, "X");
});

test("pins keep their places when those that they refer to go", () => {
  const found = byLengths();
  assert.deepEqual(d.renamePin(found, "B", "X").pins.P, {...found.pins.P, from: "X", line: ["X", "C"]});
  const gone = d.removeElements(found, [{kind: "pin", name: "A"}]);
  near(d.placeOf(gone, "B"), d.placeOf(found, "B"));
  assert.ok(Array.isArray(gone.pins.B) && !Array.isArray(gone.pins.C));
  const merged = d.mergePins(found, "M", "C");
  assert.deepEqual([merged.pins.C, Object.keys(merged.pins)], [found.pins.C, ["C", "P", "A", "B", "D"]]);
  for (const [words, value] of forms.formsOf(found, "C", ["B", "D", "P"])) {
    near(d.placeOf({...found, pins: {...found.pins, C: value}}, "C"), d.placeOf(found, "C"));
    assert.ok(!words.includes("P"));  // P follows from C
  }
});

test("a senseless action is a problem in words", () => {
  const found = fourBar();
  for (const result of [actions.drawLink(found, at(0, 0, "A"), at(0, 0, "A"), context), actions.drawLink(found, at(0, 0, "A"), at(0, 0, "B"), context),
    actions.drawMotor(found, at(0.5, 0.5)), actions.drawSlide(found, at(1, 1), at(2, 1), context), actions.drawSlot(found, at(1, 1), at(2, 1)),
    actions.drawGear(found, at(0, 0, null, 0), at(0, 0, null, 0)), actions.drawCam(found, at(0, 0, "A"), at(1, 1)), actions.drawLoad(found, at(1, 1), at(2, 1), context),
    actions.drawSpring(found, at(0, 0, "A"), at(0.03, 0.04, "B")), actions.drawPlate(found, [at(0, 0), at(1, 1), at(2, 2)], context)]) {
    assert.equal(typeof result.problem, "string");
    assert.equal(result.document, undefined);
  }
});

test("a pin on a bar lies on its line, between its ends", () => {
  const [found, pin] = d.addPin(fourBar(), [1, 1]), [made, name] = joining.addPinToLink(fourBar(), 0, [0.015, 0.03]);
  assert.equal(pin, "E");
  assert.deepEqual(made.link[0].pins, ["A", name, "B"]);
  const [x, y] = made.pins[name];
  assert.ok(Math.abs(30 * y - 40 * x) < 1e-9 && x > 0 && x < 30);
  assert.deepEqual(found.pins.E, [1000, 1000]);
});

test("a pin on a plate's edge keeps the order of its corners", () => {
  const {document} = actions.drawPlate(d.EMPTY, [at(0, 0), at(0.1, 0), at(0.1, 0.1), at(0, 0.1)], context);
  const [made, name] = joining.addPinToLink(document, 0, [0.1, 0.05]);
  assert.deepEqual(made.link[0].pins, ["A", "B", name, "C", "D"]);
});

test("merging pins keeps everything at them, and drops links left with one pin", () => {
  const found = d.mergePins(fourBar(), "B", "A");
  assert.deepEqual(found.link.map(link => link.pins), [["A", "C"], ["D", "C"]]);
  assert.ok(!("B" in found.pins));
  assert.equal(d.mergePins(fourBar(), "A", "A").link.length, 3);
});

test("deleting an item deletes everything that needs it, and nothing else", () => {
  const whole = fourBar();
  assert.deepEqual(d.removeElements(whole, [{kind: "link", index: 0}]).motor, undefined);
  assert.deepEqual(Object.keys(d.removeElements(whole, [{kind: "link", index: 0}]).pins), ["B", "C", "D"]);
  assert.deepEqual(d.removeElements(whole, [{kind: "pin", name: "C"}]).link.map(link => link.pins), [["A", "B"]]);
  assert.deepEqual(d.removeElements(whole, [{kind: "motor", index: 0}]), Object.fromEntries(Object.entries(whole).filter(([key]) => key !== "motor")));
  assert.deepEqual(d.removeElements(whole, []), whole);
});

test("a slide goes with its motor, and names follow a renaming", () => {
  let found = actions.drawSlide(fourBar(), at(0.12, 0.09, "C"), at(0.2, 0.09), context).document;
  const index = found.link.findIndex(link => link.pins.length === 1);
  found = actions.drawMotor(found, at(0, 0, null, index)).document;
  assert.equal(found.motor[1].slide, "slide1");
  assert.equal(d.renameElement(found, "slide", 0, "ram").motor[1].slide, "ram");
  assert.equal(d.renameElement(found, "link", index, "block").slide[0].link, "block");
  assert.equal(d.renameElement(found, "link", 0, "link2"), found);
  assert.deepEqual(d.renamePin(found, "A", "O").ground, ["O", "D"]);
  assert.equal(d.renamePin(found, "A", "B"), found);
  assert.equal(d.removeElements(found, [{kind: "slide", index: 0}]).motor.length, 1);
});

test("every tool that draws makes what its name says", () => {
  const base = fourBar(), disc = actions.drawDisc(base, at(0.2, 0.2), at(0.23, 0.2), context).document;
  const two = actions.drawGround(actions.drawDisc(actions.drawGround(disc, at(0, 0, "E")).document, at(0.3, 0.2), at(0.37, 0.2), context).document, at(0, 0, "F")).document;
  const gear = actions.drawGear(two, at(0, 0, "E"), at(0, 0, "F")).document.gear[0];
  assert.deepEqual(gear, {links: ["disc1", "disc2"], teeth: [20, 47]});
  assert.deepEqual(actions.drawSlot(two, at(0.12, 0.09, "C"), at(0.2, 0.09)).document.slot[0].direction, [1, 0]);
  assert.deepEqual(actions.drawSpring(base, at(0.03, 0.04, "B"), at(0, 0.2)).document.spring[0].between, ["B", "E"]);
  assert.deepEqual(actions.drawSpring(base, at(0, 0, "A"), {...at(0, 0, "A"), isClick: true}).document.spring[0], {pin: "A", stiffness: "10 N m/rad"});
  assert.deepEqual(actions.drawDamper(base, at(0.03, 0.04, "B"), at(0.1, 0, "D")).document.damper[0].between, ["B", "D"]);
  assert.deepEqual(actions.drawLoad(base, at(0.03, 0.04, "B"), at(0.03, -0.01), context).document.load[0], {pin: "B", force: ["0 N", "-10 N"]});
  assert.equal(TOOLS.filter(tool => tool.make).length, 13);
  assert.equal(new Set(TOOLS.map(tool => tool.key)).size, TOOLS.length);
});

test("the follower of a new cam stands on its profile", () => {
  let found = actions.drawGround(actions.drawDisc(d.EMPTY, at(0.1, 0.06), at(0.12, 0.06), context).document, at(0, 0, "A")).document;
  found = actions.drawLink(found, at(0.12, 0.09), at(0.12, 0.15), context).document;
  found = actions.drawCam(found, at(0.1, 0.06, "A"), at(0.12, 0.09, "B")).document;
  const outline = shapes.camOutline(found, found.cam[0]), away = Math.hypot(0.02, 0.03);
  assert.ok(Math.min(...outline.points.map(([x, y]) => Math.hypot(x - 0.12, y - 0.09))) < 0.03 * away);
  assert.ok(Math.abs(Math.max(...outline.points.map(([x, y]) => Math.hypot(x - 0.1, y - 0.06))) - 1.4 * away) < 1e-3 * away);
});

test("segments of a cam by laws: every change leaves a whole turn and a follower that comes back", () => {
  const document = freeze({...d.EMPTY, units: {length: "mm", angle: "deg"}, pins: {O: [0, 0], P: [0, 40]}}), degrees = x => x * Math.PI / 180;
  const profile = freeze({base: 40, law: ["cycloidal", "dwell", "3-4-5", "dwell"], angle: [120, "60 deg", 90, 90], lift: [20, 0, "-20 mm", 0]});
  const wide = cams.withAngle(profile, 0, degrees(150), document), high = cams.withStep(profile, 0, 0.025, document);
  assert.deepEqual([wide.angle, high.lift], [[150, "30 deg", 90, 90], [25, 0, "-25 mm", 0]]);
  assert.deepEqual(cams.withAngle(profile, 3, degrees(100), document).angle, [120, "60 deg", 80, 100]);
  assert.equal(cams.withAngle(profile, 0, degrees(180), document), null);  // no room for the dwell
  assert.equal(cams.withStep(profile, 1, 0.001, document), null);
  const still = cams.withLaw(profile, 0, "dwell", document);
  assert.deepEqual([still.law[0], still.lift], ["dwell", [0, 0, "0 mm", 0]]);
  assert.equal(cams.withLaw(cams.withLaw(still, 2, "dwell", document), 0, "harmonic", document).law[0], "harmonic");
  const more = cams.withSegment(profile, document), less = cams.withoutSegment(more, 0, document);
  assert.deepEqual([more.angle, more.law.length], [[120, "60 deg", 90, 45, 45], 5]);
  assert.deepEqual([less.angle, less.lift], [["180 deg", 90, 45, 45], [0, "0 mm", 0, 0]]);
  const laws = cams.profileByLaws(document, {pins: ["O", "P"], profile: {angle: [0, 120, 240], radius: [40, 55, 45]}});
  assert.deepEqual([laws.base, laws.angle, laws.lift], [40, [120, 60, 120, 60], [15, 0, -15, 0]]);
});

test("the outline of a cam by laws touches its follower as drawn, whether that slides past the centre, swings, or is flat", () => {
  const law = ["harmonic", "dwell", "harmonic"], units = {length: "mm", angle: "deg"}, angles = [120, 120, 120];
  const drawn = (pins, follower, profile, more = {}) => ({
    format: 2, units, ground: ["O", "Q"], pins: {O: [0, 0], Q: [90, 0], ...pins}, link: [{name: "cam", pins: ["O"]}, {name: "follower", pins: follower}],
    slide: follower.length > 1 ? [] : [{link: "follower", direction: [0, 1]}], cam: [{pins: ["O", "P"], profile: {base: 40, law, angle: angles, ...profile}, ...more}]});
  const touches = (document, [x, y]) => Math.min(...shapes.camOutline(document, document.cam[0], 720).points.map(p => Math.hypot(p[0] - x, p[1] - y)));
  const lift = {lift: [20, 0, -20]}, swing = {swing: [25, 0, -25]}, height = Math.sqrt(40 ** 2 - 12 ** 2), psi = Math.acos((90 ** 2 + 70 ** 2 - 40 ** 2) / (2 * 90 * 70));
  assert.ok(touches(drawn({P: [12, height]}, ["P"], lift), [0.012, height / 1e3]) < 1e-12);
  const place = [90 - 70 * Math.cos(psi), 70 * Math.sin(psi)];
  assert.ok(touches(drawn({P: place}, ["Q", "P"], swing), place.map(x => x / 1e3)) < 1e-12);
  assert.ok(touches(drawn({P: [0, 40]}, ["P"], lift, {face: [0, 1]}), [0, 0.04]) < 1e-6);
  assert.ok(Math.abs(Math.max(...shapes.camOutline(drawn({P: [12, height]}, ["P"], lift), drawn({}, ["P"], lift).cam[0]).points.map(p => Math.hypot(...p))) - Math.hypot(12, height + 20) / 1e3) < 1e-9);
  assert.equal(shapes.camOutline(drawn({P: [0, 30]}, ["P"], swing), {pins: ["O", "P"], profile: {base: 40, law, angle: angles, ...swing}}), null);
});

test("the path of a pin is a smooth curve where its link turns fast, from few instants", async () => {
  const {pathsOf} = await page("page_run"), n = 9, turn = k => 2 * Math.PI * k / (n - 1);
  const run = {ts: Float64Array.from({length: n}, (_, k) => k), count: n, q: new Float64Array(3 * n), v: new Float64Array(3 * n)};
  for (let k = 0; k < n; k++) { run.q[3 * k + 2] = turn(k); run.v[3 * k + 2] = turn(1); }
  const [{line}] = pathsOf(run, new Float64Array(3), [0], [{name: "A", link: 0, place: [1, 0]}]);
  for (let k = 2; k < line.length; k += 2) {
    const middle = [(line[k] + line[k - 2]) / 2, (line[k + 1] + line[k - 1]) / 2];
    assert.ok(Math.abs(Math.hypot(...middle) - 1) < 1e-3);
  }
});

test("a periodic spline goes through its values and has no corner where it closes", () => {
  const angles = [0, 1, 2.5, 4, 5], values = [1, 2, 1.5, 3, 1.2], f = shapes.periodicSpline(angles, values);
  angles.forEach((x, k) => assert.ok(Math.abs(f(x) - values[k]) < 1e-13));
  assert.ok(Math.abs(f(2 * Math.PI) - values[0]) < 1e-13);
  const h = 1e-5, slope = x => (f(x + h) - f(x - h)) / (2 * h);
  assert.ok(Math.abs((f(h) - f(0)) / h - (f(0) - f(-h)) / h) < 1e-3);
  assert.ok(Math.abs(slope(1e-4) - slope(2 * Math.PI - 1e-4)) < 1e-2);
});

test("slots keep their pins on the line of two pins that move", () => {
  let found = {...fourBar(), slot: [{pin: "C", along: ["A", "B"], on: "link1"}]};
  found = d.settle(d.movePin(found, "B", [0.05, 0]));
  assert.deepEqual(found.pins.C, [120, 0]);
  assert.equal(d.settle(found), found);
});

test("pins between the ends of a bar stay on it", () => {
  const [made, name] = joining.addPinToLink(fourBar(), 1, [0.075, 0.065]), moved = d.settle(d.movePin(made, "C", [0.13, 0.04]));
  const [x, y] = moved.pins[name], [[bx, by], [cx, cy]] = [moved.pins.B, moved.pins.C];
  assert.ok(Math.abs((cx - bx) * (y - by) - (cy - by) * (x - bx)) < 1e-8);
  assert.ok(x > bx && x < cx);
  const folded = d.settle(d.movePin(made, "C", [0.03, 0.05])).pins[name];  // which would leave it outside
  assert.ok(folded[1] > 40 && folded[1] < 50);
});

/** Copies of some items, (dx, dy) metres away: what a duplicate and a paste into another drawing add. */
const copied = (document, items, to = document) => clipboard.withFragment(to, JSON.parse(JSON.stringify(clipboard.fragmentOf(document, items))), 0.01, -0.01);
const all = document => [...Object.keys(document.pins).map(name => ({kind: "pin", name})), ...d.LISTS.flatMap(kind => d.list(document, kind).map((_, index) => ({kind, index})))];

test("copies have pins of their own", () => {
  const {document: found, select} = copied(fourBar(), [{kind: "link", index: 0}, {kind: "link", index: 1}]);
  assert.deepEqual(select.filter(({kind}) => kind === "link").map(({index}) => found.link[index].pins), [["E", "F"], ["F", "G"]]);
  assert.deepEqual(found.pins.F, [40, 30]);
  assert.deepEqual(found.ground, ["A", "D", "E"]);
});

test("a whole drawing is copied with its motor, its forms and its numbers", () => {
  const before = freeze({...byLengths(), numbers: {r: 40, s: "2*r"}, pins: {...byLengths().pins, B: {from: "A", length: "r", angle: 60}, D: ["s + 20", 0]}});
  for (const to of [before, freeze(d.EMPTY)]) {
    const {document: found, select, note} = copied(before, all(before), to), added = Object.keys(found.pins).length - Object.keys(to.pins).length;
    assert.equal(note, "");
    assert.equal(added, 6);
    assert.equal(select.length, 6 + 3 + 1);
    assert.deepEqual(found.numbers, before.numbers);
    const motor = found.motor.at(-1), [crank, coupler] = found.link.slice(-3);
    assert.deepEqual(motor.pin, crank.pins[0]);
    const length = ({pins: [a, b]}) => Math.hypot(...[0, 1].map(k => d.placeOf(found, a)[k] - d.placeOf(found, b)[k]));
    near([1000 * length(crank), 1000 * length(coupler)], [40, 120]);
    assert.deepEqual(found.pins[crank.pins[1]], {from: crank.pins[0], length: "r", angle: 60});
    near(d.placeOf(found, motor.pin), [0.01, -0.01]);
    assert.equal(shapeProblem(found), "");
  }
});

test("coordinates of a link move with its copy, and a file of an outline stays its file", () => {
  const square = (x, size) => [[x, 0], [x + size, 0], [x + size, size], [x, size]], own = {outline: square(0, 40), holes: [square(10, 5)], centre: [20, 20]};
  const given = freeze({...fourBar(), link: fourBar().link.map((link, k) => (k === 0 ? {...link, ...own} : k === 1 ? {...link, outline: {file: "a.dxf"}} : link))});
  const links = copied(given, [{kind: "link", index: 0}, {kind: "link", index: 1}]).document.link.slice(-2);
  assert.deepEqual([links[0].outline[0], links[0].holes[0][2], links[0].centre], [[10, -10], [25, -5], [30, 10]]);
  assert.deepEqual(links[1].outline, {file: "a.dxf"});
});

test("what a copy names is taken from the drawing, or it is left out and named", () => {
  const before = fourBar(), inches = freeze({...d.EMPTY, units: {length: "in", angle: "deg"}, pins: {X: [0, 0]}});
  const motor = [{kind: "motor", index: 0}];
  assert.equal(copied(before, motor).document.motor.length, 2);
  assert.match(copied(before, motor, freeze({...d.EMPTY, pins: {X: [0, 0]}})).note, /^motor1 is left out: A is not in this drawing/);
  assert.match(copied(before, motor, inches).problem, /other units/);
  const r = freeze({...before, numbers: {r: 40}, pins: {...before.pins, B: {from: "A", length: "r", angle: 60}}});
  assert.equal(copied(r, all(r), freeze({...before, numbers: {r: 30}})).note, "r stays 30");
});

test("an area holds the elements whose pins and links it holds", () => {
  const found = fourBar(), places = new Map(Object.keys(found.pins).map(name => [name, d.placeOf(found, name)]));
  const kinds = area => picking.itemsWithin(found, places, ...area).map(({kind, index, name}) => `${kind} ${name ?? index}`).sort();
  assert.deepEqual(kinds([[-1, -1], [0.05, 1]]), ["link 0", "motor 0", "pin A", "pin B"]);
  assert.equal(kinds([[-1, -1], [1, 1]]).length, 4 + 3 + 1);
});

test("a motor moves a slide by its rail or its link, or, between two pins, a cylinder", () => {
  const slider = freeze(actions.drawSlide(fourBar(), at(0.12, 0.09, "C"), at(0.2, 0.09), context).document), rail = {...at(0.2, 0.09), slide: 0};
  const found = freeze(actions.drawMotor(slider, rail).document);
  assert.deepEqual(found.motor.at(-1), {slide: "slide1", speed: "0.1 m/s"});
  assert.deepEqual(actions.drawMotor(found, rail).select, [{kind: "motor", index: 1}]);
  assert.deepEqual(actions.drawMotor(slider, at(0.12, 0.09, null, 3)).document.motor.at(-1), {slide: "slide1", speed: "0.1 m/s"});
  const cylinder = actions.drawCylinder(fourBar(), at(0, 0, "A"), at(0.12, 0.09, "C")).document.motor.at(-1);
  assert.deepEqual(cylinder, {between: ["A", "C"], speed: "0.1 m/s"});
  const fresh = actions.drawCylinder(fourBar(), at(0.05, 0), at(0.12, 0.09, "C")).document;
  assert.deepEqual([fresh.motor.at(-1).between, fresh.ground], [["E", "C"], ["A", "D", "E"]]);
  assert.match(actions.drawCylinder(fourBar(), at(0, 0, "A"), at(0.03, 0.04, "B")).problem, /both ends are on link1/);
});

test("ground and cam make the pins that they need, and a motor at a slot says what to do", () => {
  const grounded = actions.drawGround(fourBar(), at(0.2, 0)).document;
  assert.deepEqual([grounded.pins.E, grounded.ground], [[200, 0], ["A", "D", "E"]]);
  const lever = actions.drawLink(d.EMPTY, at(0, 0.1), at(0.1, 0.1), context).document, disc = actions.drawDisc(lever, at(0.05, 0.05), at(0.06, 0.05), context).document;
  const cam = actions.drawCam(disc, at(0.05, 0.05, "C"), at(0.07, 0.1, null, 0)).document;
  assert.deepEqual([cam.cam[0].pins, cam.link[0].pins, cam.pins.D], [["C", "D"], ["A", "D", "B"], [70, 100]]);
  const slot = actions.drawSlot(actions.drawLink(d.EMPTY, at(0, 0), at(0.1, 0), context).document, at(0.1, 0, "B"), at(0.2, 0)).document;
  assert.match(actions.drawMotor(slot, at(0.1, 0, "B")).problem, /replace the slot by a slide/);
});

/** Drawings whose pins are given in each of the ways in which dimensions are. */
function dimensioned() {
  const plate = freeze({...byLengths(), link: byLengths().link.map(({width, ...link}) => link)});
  const slider = freeze({...d.EMPTY, ground: ["A"], pins: {A: [0, 0], B: {from: "A", length: 50, angle: 60}, C: [160, -20]}, motor: [{pin: "A", speed: "60 rpm"}],
    link: [{name: "crank", pins: ["A", "B"]}, {name: "rod", pins: ["B", "C"]}, {name: "slider", pins: ["C"]}], slide: [{name: "rail", link: "slider", direction: 0}]});
  const named = freeze({...plate, numbers: {r: 40}, pins: {...plate.pins, B: {from: "A", length: "r", angle: "1.5*r"}, D: ["2.5*r", 12]}});
  return [fourBar(), plate, named, slider];
}

test("a dimension takes what is typed, and the other ones stay or are named", () => {
  const valueOf = words => parseFloat(words.split("= ").at(-1));
  const count = dimensioned().map(document => {
    const marks = marksOf(document), values = new Map(marks.map(({key, words}) => [key, valueOf(words)]));
    for (const {key, words, typed, take} of marks) {
      const wanted = 1.02 * values.get(key), {document: found, note, problem} = take(String(wanted));
      assert.equal(problem, undefined, `${key} ${words}`);
      assert.equal(document, freeze(document));
      for (const other of marksOf(found)) {
        const now = valueOf(other.words), before = other.key === key ? wanted : values.get(other.key);
        const isNamed = note.includes(other.key.split(" ")[1]);
        assert.ok(Math.abs(now - before) < 1e-5 * Math.abs(before) || (other.key !== key && isNamed), `${key}: ${other.key} is ${now}, not ${before}; ${note}`);
      }
      assert.match(take("no number").problem, /is not an? (length|angle)/, key);
      assert.ok(typed.length > 0);
    }
    return marks.length;
  });
  assert.deepEqual(count, [4, 7, 8, 4]);
});

test("an expression of named numbers that is typed as a dimension stays", () => {
  const [, , named] = dimensioned(), mark = key => marksOf(named).find(one => one.key === key);
  assert.deepEqual(["link link1", "angle B", "support D 0", "support D 1"].map(key => mark(key).words), ["r = 40", "1.5*r = 60°", "2.5*r = 100", "12"]);
  assert.equal(mark("link link1").take("r + 2").document.pins.B.length, "r + 2");
  assert.equal(mark("support D 0").take("3*r").document.pins.D[0], "3*r");
  assert.equal(mark("angle B").take("2*r").document.pins.B.angle, "2*r");
  assert.equal(mark("support D 1").take("-12").document.pins.D[1], -12);
});

test("angles have ticks at parts of a turn, and the extremes of a curve are found", () => {
  assert.deepEqual(chart.ticks([0, 360], 7, true), [0, 90, 180, 270, 360]);
  assert.deepEqual(chart.ticks([60, 420], 7, true), [90, 180, 270, 360]);
  assert.deepEqual(chart.ticks([0, 3600], 7, true), [0, 720, 1440, 2160, 2880, 3600]);
  assert.deepEqual(chart.extremesOf([3, NaN, 1, 5, 9], 4), [2, 3]);
  assert.deepEqual(chart.extremesOf([2, 2 + 1e-12, 2], 3), []);
});

test("one turn of a motor is the first one of the run", () => {
  for (const sign of [1, -1]) {  // a body that turns by 0.1 rad an instant, twice around
    const q = Float64Array.from({length: 3 * 126}, (_, k) => (k % 3 === 2 ? sign * 0.1 * Math.floor(k / 3) : 0)), run = {q, ts: Float64Array.from({length: 126}, (_, k) => k), count: 126};
    const scene = {bodies: ["crank"], drivers: [{name: "motor", pair: [-1, 0], offset: Math.PI / 3}]};
    const whole = alongOf(run, scene, "motor"), turn = alongOf(run, scene, "motor", true);
    near(turn.range, [60, 60 + sign * 360].sort((a, b) => a - b));
    assert.equal(turn.count, 64);  // 0.1 * 63 is the first angle beyond a turn
    assert.equal(whole.count, 126);
    near([turn.at(70)], [60 + sign * (7 * 180 / Math.PI - 360)]);
    near([turn.timeOf(60 + sign * 180)], [10 * Math.PI]);
  }
});

test("undo and redo restore the very states, and an equal state adds no step", () => {
  const history = new History({n: 0}), states = [history.state], equal = (a, b) => a.n === b.n;
  for (let n = 1; n <= 50; n++) {
    states.push({n});
    assert.equal(history.push(states[n], equal), true);
    assert.equal(history.push({n}, equal), false);
  }
  for (let n = 49; n >= 0; n--) assert.equal(history.undo(), states[n]);
  assert.equal(history.canUndo, false);
  assert.equal(history.undo(), states[0]);
  for (let n = 1; n <= 50; n++) assert.equal(history.redo(), states[n]);
  history.undo();
  history.push({n: 99});
  assert.equal(history.canRedo, false);
});

test("lengths are read and written with units", () => {
  const document = {units: {length: "mm", angle: "deg"}};
  assert.equal(units.length("1.5 in", document), 1.5 * 0.0254);
  assert.equal(units.length("3 µm", document), 3e-6);
  assert.equal(units.direction("90°", {}), Math.PI / 2);
  assert.equal(units.length(12, document), 12e-3);
  assert.ok(Number.isNaN(units.length("12 parsec", document)) && Number.isNaN(units.length(null, document)) && Number.isNaN(units.length("nan", document)));
  assert.equal(units.written(0.0305, document), 30.5);
  assert.equal(units.written(0.0305, document, "3 cm"), "3.05 cm");
  assert.equal(units.direction([0, 2], document), Math.PI / 2);
  assert.equal(units.direction(90, document), Math.PI / 2);
  for (const x of [0.1, 0.3, 1 / 3, 123.456]) assert.ok(Math.abs(units.written(x / 1000, document) - x) <= 1e-12 * x);
  assert.equal(units.niceBelow(7.3), 5);
  assert.equal(units.niceBelow(0.001), 0.001);
});

test("values are typed as they are shown", () => {
  assert.equal(valueText([0.1 + 0.2, 1 / 3]), "[0.3, 0.333333333333333]");  // without rounding errors
  for (const value of [12, -1.5e-3, "12 mm", ["A", "B"], [1, 2], ["0 N", "-10 N"], [[1, 2], [3, 4]], true, {type: "sine", amplitude: 1}]) assert.deepEqual(readValue(valueText(value)), Array.isArray(value) && value.every(x => /^[A-Z]$/.test(x)) ? "A, B" : value);
  assert.deepEqual(readValue("A, B", true), ["A", "B"]);
  assert.equal(readValue("12", true), "12");
  assert.equal(readValue("  "), undefined);
});

test("the view zooms about a pixel and fits all points", () => {
  const before = {scale: 1000, x: 10, y: 20}, pixel = [300, 200], after = view.zoomAt(before, pixel, view.ZOOM_STEP);
  view.toMetres(before, pixel).forEach((x, k) => assert.ok(Math.abs(x - view.toMetres(after, pixel)[k]) < 1e-15));
  const fitted = view.fit([[0, 0], [2, 1]], 800, 600, 1);
  for (const place of [[0, 0], [2, 1]]) {
    const [x, y] = view.toPixels(fitted, place);
    assert.ok(x > 0 && x < 800 && y > 0 && y < 600);
  }
  assert.ok(Number.isFinite(view.fit([[1, 1]], 800, 600, 1).scale) && Number.isFinite(view.fit([], 800, 600, 1).scale));
});

test("the nearest pin is picked, then the topmost symbol", () => {
  const places = new Map([["A", [0, 0]], ["B", [8, 0]]]);
  assert.equal(picking.pinAt(places, [5, 0]), "B");
  assert.equal(picking.pinAt(places, [5, 0], false, "B"), "A");
  assert.equal(picking.pinAt(places, [50, 0]), null);
  const plate = {of: {kind: "link", index: 0}, closed: true, width: 8, points: [[20, 20], [80, 20], [80, 80], [20, 80]]};
  const bar = {of: {kind: "link", index: 1}, closed: false, width: 11, points: [[20, 50], [90, 50]]};
  assert.equal(picking.itemAt([plate, bar], places, [50, 52]).index, 1);
  assert.equal(picking.itemAt([plate, bar], places, [50, 70]).index, 0);
  assert.equal(picking.itemAt([plate, bar], places, [150, 70]), null);
});

test("every element has symbols that name it, and strange ones have none", () => {
  const document = {...fourBar(), slide: [{link: "link3", direction: 0}], slot: [{pin: "C", direction: [0, 1]}], spring: [{between: ["A", "C"], stiffness: 1, damping: 1}, {pin: "A", stiffness: 1}],
    damper: [{between: ["B", "D"], damping: 1}], load: [{pin: "C", force: ["1 N", 0]}, {link: "link2", torque: "-1 N m"}]};
  const kinds = new Set(symbolsOf(document, 1e-3).map(({of}) => `${of.kind}${of.index ?? of.name}`));
  for (const name of ["link0", "link2", "pinA", "pinD", "slide0", "slot0", "spring0", "spring1", "damper0", "load0", "load1", "motor0"]) assert.ok(kinds.has(name), name);
  const strange = {format: 2, pins: {A: ["nan", 0], B: null, C: [1], D: [0, 0]}, link: [{name: "x", pins: ["A", "Z"]}, {name: "y"}, {name: "z", pins: ["D"]}], motor: [{}, {pin: "Z"}, {slide: "no"}],
    gear: [{}, {links: ["x", "y"], teeth: [0, 0]}], cam: [{}, {pins: ["A", "D"], profile: {angle: [1, 2, 3], radius: ["x", 1, 1]}}], slide: [{}], slot: [{}], spring: [{}, {between: ["A", "D"]}], damper: [{}], load: [{}]};
  for (const {points = [], frame} of symbolsOf(strange, 1e-3)) assert.ok([...points.flat(), ...frame.flat()].every(Number.isFinite));
});

test("outlines are drawn with their holes, those of files once the server has read them", () => {
  const corners = [[0, 0], [20, 0], [20, 20], [0, 20]], hole = [[5, 5], [8, 5], [8, 8]], units = {length: "mm"}, file = {file: "link.dxf", pin: 8};
  const drawn = outline => symbolsOf({format: 2, units, pins: {A: [1, 1]}, link: [{name: "x", pins: ["A"], ...outline}]}, 1e-3).filter(({of, closed}) => of.kind === "link" && closed);
  const here = drawn({outline: corners, holes: [hole]}), metres = points => points.map(([x, y]) => [1e-3 * x, 1e-3 * y]);
  assert.deepEqual(here.map(({points, fill}) => [points.length, fill]), [[4, "edge:0"], [4, "tint:0"], [3, "back"]]);
  assert.ok(here[2].points.flat().every((x, k) => Math.abs(x - 1e-3 * hole.flat()[k]) < 1e-15));
  assert.equal(drawn({outline: file}).length, 0);
  shapes.keepOutlines([{file, outline: metres(corners), holes: [metres(hole)]}]);
  assert.deepEqual(drawn({outline: file}), here);
  for (const holes of [3, [3], ["x"], [[["a", 1]]]]) assert.doesNotThrow(() => drawn({outline: corners, holes}));
});

test("a view deep inside a drawing, or of extremely far places, costs nothing", () => {
  const document = {...fourBar(), slide: [{link: "link3", direction: 0}]};
  assert.ok(symbolsOf(document, 1e-12).length < 500);
  const far = view.fit([[1e308, -1e308], [-1e308, 1e308]], 800, 600, 1);
  assert.ok(Object.values(far).every(Number.isFinite));
});

test("a body's frames become a motion of the drawing, and a run is smooth between its instants", () => {
  const drawn = Float64Array.of(1, 2, 0.3), q = Float64Array.of(4, 5, 0.3 + Math.PI / 2), motions = motionsOf(q, drawn, [0, -1]);
  const [x, y] = carry(motions, 0, [2, 2]);
  assert.ok(Math.abs(x - 4) < 1e-12 && Math.abs(y - 6) < 1e-12);
  assert.deepEqual(carry(motions, 1, [7, 8]), [7, 8]);
  assert.deepEqual(carry(motions, -1, [7, 8]), [7, 8]);
  const run = {ts: [0, 1, 2], q: [0, 1, 8], v: [0, 3, 12], count: 3};  // t^3
  for (const t of [0, 0.3, 1, 1.7, 2]) {
    const state = stateAt(run, t, 1);
    assert.ok(Math.abs(state.q[0] - t ** 3) < 1e-12 && Math.abs(state.v[0] - 3 * t * t) < 1e-12);
  }
});

test("texts are legible on all backgrounds", async () => {
  const {THEMES, contrast, mix, readable} = await page("player/painter");
  assert.equal(contrast("#000000", "#ffffff"), 21);
  for (const theme of Object.values(THEMES)) {
    const {back, panel, ink, soft, accent, onAccent, force, bodies} = theme, texts = [ink, soft, accent, force, ...bodies.map(colour => readable(colour, theme))];
    for (const colour of texts) for (const ground of [back, panel]) assert.ok(contrast(colour, ground) >= 4.5, `${colour} on ${ground}`);
    assert.ok(contrast(mix(accent, ink, 0.25), mix(panel, accent, 0.14)) >= 4.5);  // a pressed button
    assert.ok(contrast(onAccent, accent) >= 4.5);
  }
});

test("any content of a file is drawn, or refused as not being a drawing", () => {
  const whole = {
    format: 2, units: {length: "mm", angle: "deg"}, ground: ["A", "D"], pins: {A: [0, 0], B: [30, 40], C: [120, 90], D: [100, 0], E: [60, 60]},
    link: [{name: "crank", pins: ["A", "B"], density: 7850, width: 15, thickness: 5}, {name: "plate", pins: ["B", "C", "E"], mass: "1 kg", centre: [70, 60], outline: [[0, 0], [1, 0], [0, 1]]},
      {name: "rocker", pins: ["D", "C"], mass: 1, inertia: 1}, {name: "disc", pins: ["A"], density: 1, width: 4}, {name: "block", pins: ["E"], mass: 1}],
    slide: [{link: "block", direction: [1, 0]}, {link: "block", along: ["A", "D"], on: "crank"}], slot: [{pin: "E", along: ["A", "B"], on: "crank"}, {pin: "E", direction: 30}],
    gear: [{links: ["disc", "rocker"], teeth: [20, 30]}, {links: ["disc", "rocker"], radii: [20, 80]}],
    cam: [{pins: ["A", "E"], links: ["disc", "plate"], profile: {angle: [0, 120, 240], radius: [10, 12, 11]}}],
    motor: [{pin: "A", speed: "60 rpm", of: ["ground", "crank"]}, {slide: "slide1", speed: 1}], spring: [{between: ["A", "C"], stiffness: 1}, {pin: "A", stiffness: 1}],
    damper: [{between: ["A", "C"], damping: 1}, {pin: "A", damping: 1}], load: [{pin: "C", force: ["1 N", "2 N"]}, {link: "plate", torque: 1}],
  };
  let refused = 0, drawn = 0;
  const look = document => {  // removes one element of each kind, each time another one
    symbolsOf(document, 1e-3);
    shapes.extentPoints(document);
    d.settle(document);
    for (const kind of d.LISTS) d.removeElements(document, [{kind, index: drawn % Math.max(1, d.list(document, kind).length)}]);
    const pins = Object.keys(d.pinsOf(document));
    d.removeElements(document, [{kind: "pin", name: pins[drawn % pins.length]}]);
  };
  const attempt = document => {
    if (shapeProblem(document)) refused++;
    else { look(document); drawn++; }
  };
  const odd = ["x", "", 5, NaN, true, null, [], ["x"], [5], [[1, 2]], {}, {x: 1}];
  const vary = (value, put) => {
    for (const other of odd) attempt(put(other));
    if (Array.isArray(value)) value.forEach((part, k) => vary(part, other => put(value.with(k, other))));
    else if (value && typeof value === "object") for (const [key, part] of Object.entries(value)) vary(part, other => put({...value, [key]: other}));
  };
  assert.equal(shapeProblem(whole), "");
  for (const [key, value] of Object.entries(whole)) vary(value, other => ({...whole, [key]: other}));
  assert.ok(refused > 100 && drawn > 500, `${refused} ${drawn}`);
});

test("a name never covers a sign: it moves, or is left out", async () => {
  const {Labels} = await page("player/labels"), written = [];
  const context = {canvas: {clientWidth: 400, clientHeight: 400}, measureText: words => ({width: 8 * words.length})};
  const names = new Labels();
  names.begin({context, pt: 1, text: words => written.push(words)}, []);
  names.put("sign", "R", [[100, 100, "left"]], "red", 700, true);
  names.put("there", "crank", [[80, 100, "left"]], "ink", 500);
  names.put("elsewhere", "rod", [[80, 100, "left"], [80, 200, "left"]], "ink", 500);
  names.put("chosen", "bar", [[80, 100, "left"]], "ink", 700);
  assert.deepEqual(written, ["R", "rod", "bar"]);
});

/** An engine of one body that advances by `paces` of its steps in turn, the last of which repeats. */
const pacedEngine = (paces, most = 1000) => ({size: 3, data: {settings: {max_steps: most}, why: ""}, run(values, state, times, pull, limit) {
  const end = times[times.length - 1], pace = paces.length > 1 ? paces.shift() : paces[0], t = Math.min(end, (state.t ?? times[0]) + limit * pace);
  const count = times.filter(x => x <= t).length, q = Float64Array.from({length: 3 * times.length}, (_, k) => times[Math.floor(k / 3)]);
  return {ts: times, q, v: q, violation: new Float64Array(times.length), count, events: [], steps: limit, tried: limit, t, done: t === end,
    limited: t < end, words: t < end ? "too many steps" : "", last: {t, q: [t, t, t], v: [1, 1, 1]}};
}});
const {PartRun} = await page("player/part_run");

test("a run part by part is the whole run", () => {
  const times = Float64Array.from({length: 11}, (_, k) => k / 10), parts = new PartRun(pacedEngine([0.0123]), null, {q: [0, 0, 0], v: [0, 0, 0]}, times);
  while (parts.goOn(7));
  assert.deepEqual([parts.done, parts.run.count, parts.share, parts.words], [true, 11, 1, ""]);
  assert.deepEqual(parts.run.q, Float64Array.from({length: 33}, (_, k) => times[Math.floor(k / 3)]));
});

test("a run at a standstill ends, and a slow one goes on to its limit of steps", () => {
  const times = Float64Array.of(0, 0.5, 1), run = paces => { const parts = new PartRun(pacedEngine(paces), null, {}, times); while (parts.goOn(10)); return parts; };
  const stands = run([1e-3, 1e-3, 1e-9]), slow = run([1e-5]);
  assert.deepEqual([stands.done, stands.tried, stands.words.startsWith("its steps become ever smaller")], [false, 30, true]);
  assert.deepEqual([slow.done, slow.tried, slow.words], [false, 1000, "too many steps"]);
});

test("of runs asked for meanwhile only the last is computed", async () => {
  const sent = [];
  globalThis.Worker = class { postMessage(message) { sent.push(message); } terminate() {} };
  const {Runner} = await page("runner"), runner = new Runner("data"), asked = ["a", "b", "c"].map(name => runner.run(name));
  assert.deepEqual(sent, [{data: "data"}, {request: "a"}]);
  runner.take({found: {name: "A"}});
  runner.take({found: {name: "C"}});
  assert.deepEqual([...await Promise.all(asked), sent.at(-1)], [{name: "A"}, null, {name: "C"}, {request: "c"}]);
  const waits = [];
  runner.onWait = x => waits.push(x);
  const failing = runner.run("d");
  runner.take({problem: "out of memory"});
  await assert.rejects(failing, /out of memory/);
  assert.deepEqual(waits, [true, false]);
});

test("fields take expressions, with units, in the units of the drawing", () => {
  const mm = {unit: 1e-3, units: {mm: 1e-3, cm: 1e-2}, angleUnit: Math.PI / 180};
  for (const [text, value] of [["40 + 50*cos(60)", 65], ["2*12 mm", 24], ["1 cm + 5", 15], ["-2^2", -4], ["2^-1", 0.5], ["sqrt(3)/2", Math.sqrt(3) / 2], ["atan2(1, 1)", 45],
    ["hypot(3,4) * (1 + 1)", 10], ["1e2/.5", 200], ["acos(-1)", 180], ["7", 7], ["2**3", 8]]) near([evaluate(text, mm)], [value]);
  for (const text of ["", "40 +", "cos 60", "cos(60", "(1", "x", "1 2", "window", "constructor(1)", "1 kg", "2***3"]) assert.ok(Number.isNaN(evaluate(text, mm)), text);
  const document = fourBar();
  assert.deepEqual([units.expressed("20*3", "angle", document), units.expressed("5 cm * 2", "length", document), units.expressed("abc", "length", document)], [60, 100, undefined]);
  near(units.placeFrom("50 @ 60", [0.01, 0], document), [0.035, 0.05 * Math.sin(Math.PI / 3)]);
  near(units.placeFrom("hypot(3, 4), 2*3", [1, 1], document), [0.005, 0.006]);
  assert.deepEqual(["12 mm", "5 N/mm", "2*12 mm", "-1e-3"].map(units.isMeasure), [true, false, false, true]);
});

test("bars are joined where they cross, at a pin under one, and at their middles", () => {
  let found = d.EMPTY;
  for (const [a, b] of [[at(0, 0), at(0.1, 0.1)], [at(0, 0.1), at(0.1, 0)]]) found = freeze(actions.drawLink(found, a, b, context).document);
  const reach = {...context, reach: 0.002}, crossed = joining.drawPin(found, at(0.0505, 0.05, null, 0), reach);
  const [{name}] = crossed.select;
  near(d.placeOf(crossed.document, name), [0.05, 0.05]);
  assert.deepEqual(d.members(crossed.document, name), ["link1", "link2"]);
  near(joining.snapOnLink(found, 0, [0.0495, 0.05], 0.002), [0.05, 0.05]);
  assert.equal(joining.snapOnLink(found, 0, [0.03, 0.03], 0.002), null);
  const over = actions.drawLink(found, at(0, 0.05), at(0.1, 0.0500001), context).document, loose = joining.loosePins(actions.drawLink(over, at(0.05, 0.05), at(0.05, 0.2), context).document);
  assert.deepEqual(loose, [{pin: "G", link: 0}, {pin: "G", link: 1}, {pin: "G", link: 2}]);
  const bar = actions.drawLink(found, at(0.03, 0.03), at(0.03, 0.2), context).document, joined = joining.drawPin(bar, at(0.03, 0.03, "E"), reach).document;
  assert.deepEqual(d.members(joined, "E"), ["link1", "link3"]);
  assert.deepEqual(joining.loosePins(joined), []);
  assert.equal(typeof joining.drawPin(found, at(0, 0, "A"), reach).problem, "string");
  assert.equal(typeof joining.drawPin(found, at(0.5, 0.5), reach).problem, "string");
});

test("a mass and a density replace each other", () => {
  const found = fourBar(), massive = d.withValue(found, "link", 0, "mass", "0.2 kg");
  assert.deepEqual([massive.link[0].mass, massive.link[0].density], ["0.2 kg", undefined]);
  const {thickness, ...rest} = massive.link[0], dense = d.withValue({...massive, link: [rest, ...massive.link.slice(1)]}, "link", 0, "density", 2700).link[0];
  assert.deepEqual([dense.density, dense.mass, dense.thickness], [2700, undefined, 5]);
});

test("plates with pins almost in line are reported, and a gear has its own teeth", () => {
  const plate = places => actions.drawPlate(d.EMPTY, places.map(([x, y]) => at(x, y)), context).document;
  assert.equal(shapes.thinPlates(plate([[0, 0], [0.1, 0.001], [0.2, 0]])).length, 1);
  assert.equal(shapes.thinPlates(plate([[0, 0], [0.1, 0.05], [0.2, 0]])).length, 0);
  let found = d.EMPTY;
  for (const x of [0, 0.1]) found = actions.drawDisc(found, at(x, 0), at(x + 0.05, 0), context).document;
  for (const pin of ["A", "B"]) found = actions.drawGround(found, at(0, 0, pin)).document;
  found = actions.drawGear(found, at(0, 0, null, 0), at(0, 0, null, 1)).document;
  const rims = symbolsOf(found, 1e-4).filter(({of, points}) => of.kind === "gear" && points?.length > 50);
  assert.deepEqual(rims.map(({points}) => points.length / 5), [20, 20]);
});

/** The lengths (mm) of all bars after one of them is typed. */
function typed(document, index, size, way = null) {
  const link = document.link[index], ends = link.pins.map(pin => d.placeOf(document, pin)), turn = Math.atan2(ends[1][1] - ends[0][1], ends[1][0] - ends[0][0]);
  const found = withBar(document, link, size / 1000, way ?? turn);
  const lengths = found.document?.link.filter(({pins}) => pins.length === 2).map(({pins}) => +(1000 * Math.hypot(...d.placeOf(found.document, pins[0]).map((x, k) => x - d.placeOf(found.document, pins[1])[k]))).toFixed(6));
  return {...found, lengths};
}

test("a length that was typed stays when another one is typed", () => {
  for (const swapped of [[], [1], [0, 1, 2]]) {  // in whichever order a bar names its pins
    let found = fourBar();
    found = freeze({...found, link: found.link.map((link, k) => (swapped.includes(k) ? {...link, pins: link.pins.toReversed()} : link))});
    const wanted = d.placeOf(found, "A") && [];
    for (const [k, size] of [[0, 40], [1, 120], [2, 80], [0, 45], [2, 90]]) {
      wanted[k] = size;
      const next = typed(found, k, size);
      assert.deepEqual([next.problem, next.note], [undefined, ""]);
      wanted.forEach((length, j) => assert.ok(Math.abs(next.lengths[j] - length) < 1e-6, `${next.lengths} for ${wanted}`));
      found = freeze(next.document);
    }
    assert.deepEqual([found.pins.A, found.pins.D], [[0, 0], [100, 0]]);
  }
});

const LOOP = freeze({units: {length: "mm", angle: "deg"}, ground: ["A", "D"],
  pins: {A: [0, 0], B: {from: "A", length: 40, angle: 60}, D: {from: "A", along: [3, 0], length: 100}, C: {from: ["B", "D"], length: [120, 80], side: "left"}},
  link: [["A", "B"], ["B", "C"], ["D", "C"]].map((pins, k) => ({name: `link${k + 1}`, pins}))});

test("a pin given by two lengths changes the one of its bar", () => {
  const found = LOOP, {document} = typed(found, 2, 90);
  assert.deepEqual(document.pins.C, {from: ["B", "D"], length: [120, 90], side: "left"});
  assert.deepEqual(typed(found, 0, 35).document.pins.B, {from: "A", length: 35, angle: 60});
  const {problem} = typed(found, 2, 300);
  assert.match(problem, /^link3 cannot be 300 mm long: link2 is 120 mm, and D and B are 87.178 mm apart; it needs between 32.822 mm and 207.178 mm$/);
});

const NAMED = freeze({...LOOP, numbers: {r: 40, rod: "3*r", d: "1 in", loop: "loop + 1"},
  pins: {...LOOP.pins, B: {from: "A", length: "r", angle: "r + 20"}, C: {from: ["B", "D"], length: ["rod", 80], side: "left"}}});

test("expressions of named numbers place pins, and stay when a pin is moved", () => {
  assert.deepEqual(units.numbersOf(NAMED), {r: 40, d: 25.4, rod: 120});
  near([units.length("2*r", NAMED), units.length("d", NAMED), units.angle("r", NAMED)], [0.08, 0.0254, 40 * Math.PI / 180]);
  assert.ok(Number.isNaN(units.length("2*q", NAMED)) && Number.isNaN(units.length("loop", NAMED)));
  near(d.placeOf(NAMED, "C"), d.placeOf(LOOP, "C"));
  const larger = freeze({...NAMED, numbers: {...NAMED.numbers, r: 45}});
  near([Math.hypot(...d.placeOf(larger, "B"))], [0.045]);
  assert.deepEqual(d.movePin(NAMED, "B", [0.05, 0.05]).pins.B, NAMED.pins.B);
  const {C} = d.movePin(NAMED, "C", [0.12, 0.09]).pins;
  assert.equal(C.length[0], "rod");
  assert.notEqual(C.length[1], 80);
});

test("the length of a bar may be an expression, and a typed number replaces it", async () => {
  const {lengthOf, withLengthText} = await page("dimensions");
  assert.equal(lengthOf(NAMED, NAMED.link[0]).value, "r");
  assert.deepEqual(lengthOf(NAMED, NAMED.link[1]), {pin: "C", keys: ["length", 0], value: "rod"});
  assert.deepEqual(withLengthText(NAMED, NAMED.link[2], "2*r").pins.C.length, ["rod", "2*r"]);
  assert.equal(typed(NAMED, 0, 41).document.pins.B.length, 41);
});

test("the pin of a slider stays on its line", () => {
  const found = freeze({units: {length: "mm", angle: "deg"}, ground: ["O"], pins: {O: [0, 0], A: {from: "O", length: 40, angle: 90}, S: [100, -20]},
    link: [{name: "crank", pins: ["O", "A"]}, {name: "rod", pins: ["A", "S"]}, {name: "block", pins: ["S"]}], slide: [{name: "rail", link: "block", direction: [1, 0]}]});
  const {document, note} = typed(found, 1, 150);
  assert.equal(note, "");
  assert.ok(Math.abs(document.pins.S[1] + 20) < 1e-9 && Math.abs(document.pins.S[0] - Math.sqrt(150 ** 2 - 60 ** 2)) < 1e-6);
  assert.match(typed(found, 1, 50).problem, /^rod cannot be 50 mm long: it needs at least 60 mm to the line of rail$/);
});

test("the pins of scissors move together when a length of an arm is typed", () => {
  let found = freeze({units: {length: "mm"}, ground: ["A"], pins: {A: [0, 0], B: [80, 60], C: [80, 0], D: [0, 60], E: [120, 60], F: [40, 30]},
    link: [{name: "one", pins: ["A", "F", "B"], width: 10}, {name: "other", pins: ["C", "F", "D"], width: 10}, {name: "table", pins: ["D", "E"], width: 10}, {name: "block", pins: ["C"]}],
    slide: [{name: "rail", link: "block", direction: [1, 0]}], slot: [{pin: "B", along: ["D", "E"], on: "table"}]});
  const arms = ["A F", "F B", "C F", "F D"].map(pins => pins.split(" ")), size = (document, [a, b]) => Math.hypot(...d.placeOf(document, a).map((x, k) => x - d.placeOf(document, b)[k]));
  arms.forEach((arm, k) => {
    const bar = bars(found).find(({pins}) => arm.every(pin => pins.includes(pin))), ends = bar.pins.map(pin => d.placeOf(found, pin));
    const {document, note} = withBar(found, bar, 0.06, Math.atan2(ends[1][1] - ends[0][1], ends[1][0] - ends[0][0]));
    assert.equal(note, "");
    near(arms.map(one => size(document, one)), arms.map((_, j) => (j <= k ? 0.06 : 0.05)));
    found = freeze(document);
  });
  const [B, C, D, E] = ["B", "C", "D", "E"].map(pin => d.placeOf(found, pin));
  near([size(found, ["D", "E"]), C[1], B[0] - C[0], B[1] - D[1], E[1] - D[1]], [0.12, 0, 0, 0, 0]);  // the table stays level
});

test("a bar of a long truss takes a typed length, and all others keep theirs", () => {
  const pins = {}, link = [], size = (document, {pins: [a, b]}) => Math.hypot(...d.placeOf(document, a).map((x, k) => x - d.placeOf(document, b)[k]));
  for (let k = 0; k < 60; k++) {
    pins[`P${k}`] = [40 * k, k % 2 ? 30 : 0];
    if (k) link.push({name: `bar${k}`, pins: [`P${k - 1}`, `P${k}`]});
    if (k > 1) link.push({name: `side${k}`, pins: [`P${k - 2}`, `P${k}`]});
  }
  const truss = freeze({units: {length: "mm"}, ground: ["P0", "P1"], pins, link}), bar = link.find(({name}) => name === "bar40");
  const {document, note} = withBar(truss, bar, 0.06, Math.atan2(-30, 40));
  assert.equal(note, "");
  for (const one of link) near([size(document, one) / 0.06], [one === bar ? 1 : size(truss, one) / 0.06]);
});

test("it is said which dimension gives way", () => {
  const {note, document} = typed(LOOP, 2, 80, 1.2);
  assert.match(note, /^link2 is now [0-9.]+ mm$/);
  assert.equal(document.pins.C.length[1], 80);
});

test("names of kept curves are shortened to the width of the chart, and values never", () => {
  const curves = [{name: "B: x", unit: "mm", now: 160}, {name: "A: angle between crank and coupler", unit: "°", now: 155.2}, {name: "C: speed", unit: "", now: NaN}], wide = words => 7 * words.length;
  assert.deepEqual(chart.legendOf(curves.slice(0, 1), 50, wide), ["160 mm"]);
  assert.deepEqual(chart.legendOf(curves, 900, wide), ["B: x 160 mm", "A: angle between crank and coupler 155.2 °", "C: speed –"]);
  for (const room of [500, 350, 250]) {
    const found = chart.legendOf(curves, room, wide);
    assert.ok(found.reduce((sum, words) => sum + wide(words) + 18, 0) <= room && found[1].endsWith("155.2 °"), found.join("|"));
  }
  assert.ok(chart.legendOf(curves, 500, wide)[1].startsWith("A: angl") && chart.legendOf(curves, 350, wide)[1].includes("… 155.2 °"));
});

test("a follower on a slide moves to the base circle that is typed, with its whole link, and no other follower does", () => {
  const laws = {base: 40, law: ["cycloidal", "cycloidal"], angle: [180, 180], lift: [10, -10]}, pins = {O: [0, 0], P: [0, 40], Q: [0, 110]};
  const cam = {...d.EMPTY, pins, ground: ["O"], link: [{name: "disc", pins: ["O"]}, {name: "follower", pins: ["P", "Q"]}], slide: [{link: "follower", direction: [0, 1]}], cam: [{pins: ["O", "P"], profile: laws}]};
  const found = cams.withBase(freeze(cam), 0, 45);
  assert.deepEqual(found.pins, {O: [0, 0], P: [0, 45], Q: [0, 115]});
  assert.equal(found.cam[0].profile.base, 45);
  const offset = cams.withBase(freeze({...cam, pins: {...pins, P: [24, 32], Q: [24, 110]}}), 0, 51);  // on its line, 24 mm from the centre
  near([...offset.pins.P, ...offset.pins.Q], [24, 45, 24, 123]);
  assert.deepEqual(cams.withBase(freeze({...cam, slide: []}), 0, 45).pins, pins);
  assert.deepEqual(cams.withBase(freeze({...cam, pins: {...pins, P: [24, 32]}}), 0, 20).pins, {...pins, P: [24, 32]});  // its line does not reach the base
});

test("a bar of three pins turns as a whole, and unit vectors along an axis are exact", () => {
  let found = {...d.EMPTY, pins: {O: [0, 0], M: [65, 0], B: [130, 0]}, ground: ["O"], link: [{name: "arm", pins: ["O", "M", "B"], mass: 1, width: 10}]};
  found = withTypedBar(freeze(found), {...found.link[0], pins: ["O", "B"]}, "30", "angle").document;
  near([...found.pins.M, ...found.pins.B], [65 * Math.cos(Math.PI / 6), 32.5, 130 * Math.cos(Math.PI / 6), 65]);
  assert.deepEqual([0.5, 1, 1.5].map(k => units.unitVector(k * Math.PI)), [[0, 1], [-1, 0], [0, -1]]);
});
