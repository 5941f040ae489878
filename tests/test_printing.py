"""Printing, also in notebooks: tables of numbers with units, for numbers of all kinds."""

import inspect
import re
from html.parser import HTMLParser
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.elements import DRIVERS, FORCES, JOINTS
from udkjax.printing import MOST_HTML_ROWS, MOST_ROWS, PrintedTable, format_number, format_numbers, html_table, text_table
from udkjax.scene.outlines.contours import Contour
from udkjax.scene.outlines.curves import circle
from udkjax.scene.outlines.outline import outline_of_contours

MOST_LINES = 20


class Balance(HTMLParser):
    def __init__(self, text: str):
        super().__init__()
        self.open: list[str] = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def anything(*arguments: Any) -> Any:
    """A placeholder for a user's function."""


def cells(text: str) -> list[list[str]]:
    Balance(text)
    return [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row) for row in re.findall(r"<tr>(.*?)</tr>", text)]


@pytest.fixture(scope="module")
def objects() -> dict[str, object]:
    """Return every kind of object that a user receives, by the name of its class."""
    mech, ts = udk.library.driven_pendulum(), np.linspace(0.0, 0.5, 6)
    free = udk.Mechanism({"a": udk.Body(1.0, 0.1, [0.5, 0.0])}, {"A": udk.Revolute(["ground", "a"], [[0, 0], [-0.5, 0]])})
    run = udk.simulate(free, ts, events=[udk.Event(lambda t, at: t - 0.25, udk.Log(), name="late")])
    coordinate = f"body.{free.body_names[0]}.angle"
    linkage = udk.library.four_bar()
    motion = udk.kinematics(free, coordinate, [0.1, 0.2])
    rest = udk.equilibrium(free)
    drawing = udk.Drawing({"A": [0, 0], "B": [1, 0]}, {"bar": udk.Link(["A", "B"], mass=1.0)}, ["A"])
    driven = udk.inverse_dynamics(mech, ts)
    found = [
        *(driver.motion for driver in DRIVERS.values()),
        *(free, mech, *mech.bodies.values(), *JOINTS.values(), *DRIVERS.values(), *FORCES.values()),
        *(run, run.events, udk.assemble(free), udk.check(free), udk.analyse(free), udk.energy(free, run)),
        *(motion, udk.travel(linkage, "joint.C.angle"), rest, udk.modes(free, rest.state), driven, udk.power_balance(free, run)),
        *(udk.motion_ranges(free, motion), udk.holding_efforts(free, coordinate, [0.1, 0.2])),
        udk.LiftProfile(0.04, ["cycloidal", "3-4-5"], [np.pi, np.pi], [0.02, -0.02]),
        udk.SwingProfile(0.04, ["cycloidal", "3-4-5"], [np.pi, np.pi], [0.4, -0.4], 0.09, 0.07),
        udk.motion_at(free, 0.3, coordinate),
        udk.characteristics(free, coordinate),
        *(udk.diagnose(free), udk.explain(free), udk.Workspace(jnp.ones((2, 2, 2)), jnp.ones((2, 2), bool))),
        *(udk.Baumgarte(), udk.Projection(), udk.Coordinate(("ground", "a")), udk.Event(anything, udk.Stop())),
        *(udk.JointLimit("a", 0.1), udk.Contact("a"), udk.Impact(0.5), udk.Release("a"), udk.Lock("a")),
        *(udk.Attach(JOINTS["weld"], "a"), udk.Start(), udk.Parameter("body.a.mass"), udk.Quantity("x", anything)),
        *(udk.Record(ts, {"body.a.x": ts}), udk.Candidate({"a": ts}), udk.Axis(ts), udk.Zipped({"a": udk.Axis(ts)})),
        *(udk.Sobol(4), udk.LatinHypercube(4), udk.Random(4), udk.Point(1.0, 2.0), free.bodies[free.body_names[0]].frame()),
        *(method() for method in (udk.SVD, udk.Varga, udk.Greville, udk.Householder, udk.GramSchmidt, udk.Elimination, udk.Auto)),
        *(udk.OneOf(), udk.Augmented(udk.SVD())),
        *(kind() for kind in (udk.Augmented, udk.NullSpaceQR, udk.NullSpaceSVD, udk.CoordinatePartitioning)),
        *(udk.Stop(), udk.Log(), udk.Verner65(), udk.Adams(), udk.BDF(), run.result, udk.Reached.lost),
        udk.ConstrainedSystem(mass=jnp.diag, force=anything),
        *(part for joint in JOINTS.values() for part in vars(joint).values() if isinstance(part, udk.Profile)),
        *(drawing, drawing.links["bar"], udk.Held(ts, 0.1)),
        *(udk.PathGoal("P", [[0, 0], [1, 1]]), udk.PoseGoal("a", [[0, 0, 0.1]]), udk.FunctionGoal("a", [0.1], [0.2])),
        udk.CurveGoal("P", [[0, 0], [1, 1], [2, 0]]),
        *(udk.TorqueGoal(most=1.0), udk.LoadGoal("a", most=1.0), udk.EnergyGoal(least=1.0), udk.FrequencyGoal(least=1.0)),
        *(udk.GapGoal("a", "b", least=1.0), udk.ToleranceGoal("a", {}, most=1.0), udk.MotionGoal(anything, most=1.0)),
        udk.RobustGoal(udk.EnergyGoal(most=1.0), {"gravity": 0.1}),
        *(
            (batch := udk.PositionBatch(linkage, "joint.C.angle", ["gravity"])),
            batch({"gravity": np.zeros((2, 2))}, np.array([0.1])),
        ),
        *(close := udk.gaps(linkage, "body.crank.angle", shapes=dict.fromkeys(linkage.body_names, 2.0)), close.least),
        *(close.contacts[0], udk.layers(linkage, "body.crank.angle", shapes=dict.fromkeys(linkage.body_names, 2.0))),
        *(ring := outline_of_contours([Contour((circle((0, 0), r),), "") for r in (2.0, 0.5)], ""), ring.circles[0]),
        *(udk.Tolerance(0.1, "mm"), udk.PinClearance("0.1 mm")),
        udk.tolerances(linkage, {"length(crank)": 1e-3}, ["range(body.rocker.angle)"], drive="body.crank.angle", samples=10),
        *(driven.motion, udk.feed_forward(mech, driven).forces["motor effort"], udk.animate(free, run)),
    ]
    return {type(one).__name__: one for one in found}


# In tests/study: they take a fit or a search, are made within one, or print each line of a solution.
ELSEWHERE = {"Estimate", "GradientCheck", "Design", "Designs", "FoundDesign", "DesignSearch", "MotionPoint"}
ELSEWHERE |= {"CompleteDesign", "CompleteDesigns", "CurveDesign", "CurveDesigns", "WorkedSolution"}
ELSEWHERE |= {"SystemDiagnosis", "ConstraintState", "Posterior", "Comparison"}
ABSTRACT = {"Constraint", "Joint", "RollingJoint", "Motion", "ForceElement"}
ABSTRACT |= {"MatrixPseudoinverse", "PointwiseFormulation", "Stabilization"}
RESULTS = "Mechanism Solution State Check Analysis Energy Kinematics Travel Equilibrium Modes Events PowerBalance InverseDynamics"


def test_every_public_class_prints_numbers_in_a_few_lines(objects):
    classes = {
        name for name in udk.__all__ if inspect.isclass(getattr(udk, name)) and not issubclass(getattr(udk, name), Exception)
    }
    missing = classes - set(objects) - ELSEWHERE - ABSTRACT
    assert not missing, f"give an instance of each in `objects`: {sorted(missing)}"
    assert not (ELSEWHERE | ABSTRACT) & set(objects) and classes >= ELSEWHERE | ABSTRACT
    for name, one in objects.items():
        for text in (repr(one), *([str(one)] if name in RESULTS.split() else [])):
            assert len(text.splitlines()) <= MOST_LINES and max(map(len, text.splitlines())) <= 400, (name, text)
            assert not re.search(r"\b[a-z]*[fi](32|64)\[|weak_|dtype|Array\(|0x[0-9a-f]{6}|<Result|object at", text), (name, text)


def test_results_print_their_numbers_with_units(objects):
    for name in RESULTS.split():
        text = repr(objects[name])
        assert re.search(r"\d", text) and re.search(r"\b(m|rad|kg|J|W|N m or N|s)\b", text), (name, text)
        assert cells(objects[name]._repr_html_())


def test_what_is_traced_or_batched_prints_shapes_and_is_not_computed_on(objects):
    trees = {name: one for name, one in objects.items() if isinstance(one, eqx.Module | tuple) and jax.tree.leaves(one)}
    trees = {name: one for name, one in trees.items() if all(eqx.is_array(leaf) for leaf in jax.tree.leaves(one))}
    assert len(trees) > 25
    for name, one in trees.items():
        seen: list[str] = []
        program = jax.make_jaxpr(lambda x, seen=seen: seen.append(repr(x)))(one)
        assert not program.jaxpr.eqns and "traced" in seen[0], name
        batch = jax.tree.map(lambda x: jnp.stack([x, x]), one)
        shapes = jax.eval_shape(lambda x: x, one)
        marks = [jax.tree.map(lambda x, mark=mark: mark, one) for mark in (None, True, 0, "a")]
        for other in (batch, shapes, *marks):
            assert len(repr(other).splitlines()) <= MOST_LINES, name


def test_a_result_says_how_it_ended(objects):
    assert str(udk.Result.successful) == f"{udk.Result.successful}" == "successful"
    for result in udk.Result:
        assert result.is_success or (result.label in str(result) and len(str(result)) > len(result.label) + 10)
    assert f"{udk.Reached.beyond_limit}" == "beyond limit" and int(udk.Reached.lost) == 3


def test_rounding_prints_as_zero_and_what_is_not_does_not():
    assert format_numbers([1.0, 2.2e-16], "m") == "[1, 0] m" and format_numbers([1.0, 1e-10], "m") == "[1, 1e-10] m"
    assert format_numbers([1e-15, 2.2e-16], "m") == "[1e-15, 2.2e-16] m"  # of a small mechanism
    assert format_number(3e-16, "rad", 1.0) == "0 rad" and format_number(3e-16) == "3e-16" and format_number(-0.0) == "0"
    assert (
        format_numbers(np.nan) == "nan"
        and format_numbers(np.inf, "m") == "inf m"
        and format_numbers(np.zeros(9)) == "9 numbers all 0"
    )
    assert format_numbers(np.full((2, 4), np.nan), "m") == "(2, 4) numbers m" and format_numbers(None) == "none"
    assert format_numbers(np.array([True, False])) == "1 of 2" and format_numbers(1j) == "0+1j"


def test_text_is_escaped_and_long_tables_end():
    text = html_table(PrintedTable("a & b", [('<script>"',)] * (MOST_HTML_ROWS + 5), ("<x>",)))
    assert "<script>" not in text and "a &amp; b" in text and "&lt;x&gt;" in text
    shown = cells(text)
    assert len(shown) == MOST_HTML_ROWS + 2 and shown[-1] == ["and 5 more"]
    lines = text_table(PrintedTable("a", [("b", "c" * 300)] * (MOST_ROWS + 5))).splitlines()
    assert len(lines) == MOST_ROWS + 2 and lines[-1] == "  and 5 more" and max(map(len, lines)) < 120
    assert text_table(PrintedTable("a", [])) == "a"


def test_a_mechanism_shows_each_element_with_its_bodies_and_numbers():
    mech = udk.library.slider_crank()
    shown = cells(mech._repr_html_())
    assert [row[1] for row in shown[1:]] == [*mech.bodies, *mech.joints, *mech.drivers, *mech.forces]
    body, joint = next(iter(mech.bodies)), next(iter(mech.joints))
    (row,) = [row for row in shown if row[:2] == ["body", body]]
    assert f"mass {float(mech.bodies[body].mass):.6g} kg" in row[4] and f"mass {float(mech.bodies[body].mass):.6g} kg" in str(
        mech
    )
    (row,) = [row for row in shown if row[:2] == ["joint", joint]]
    assert row[2:4] == [type(mech.joints[joint]).__name__, ", ".join(mech.joints[joint].bodies)]
    named = udk.Mechanism({"<b>": udk.Body(1.0, 1.0)}, name="<i>")
    assert "&lt;b&gt;" in named._repr_html_() and "<b>" not in named._repr_html_() and "<i>" not in named._repr_html_()


def test_traced_and_batched_numbers_of_a_mechanism_are_named_as_such():
    seen: list[str] = []
    mech = udk.library.simple_pendulum()
    body = mech.body_names[0]
    jax.make_jaxpr(lambda m: seen.append(repr(mech.with_parameters({f"body.{body}.mass": m}))))(1.0)
    assert "mass traced" in seen[0]
    batch = jax.vmap(lambda m: mech.with_parameters({f"body.{body}.mass": m}))(jnp.arange(1.0, 8.0))
    assert "mass 7 numbers from 1 to 7 kg" in str(batch)


def test_a_solution_shows_how_it_ended_what_it_took_and_where_it_got():
    mech, ts = udk.library.simple_pendulum(), np.linspace(0.0, 0.5, 6)
    sol = udk.simulate(mech, ts)
    shown = dict(cells(sol._repr_html_()))
    assert shown["result"].startswith("successful at t = 0.5 s") and shown["times"] == "6, from 0 to 0.5 s"
    assert shown["work"].startswith(f"{int(sol.stats['steps'])} steps, ") and shown["engine"] == "native"
    assert f"{float(sol.q[-1, 0, 2]):.6g} rad" in shown[mech.body_names[0]]
    batch = jax.vmap(lambda tol: udk.simulate(mech, ts, rtol=tol, throw=False, max_steps=3))(jnp.array([1e-3, 1e-12]))
    assert "of 2 members" in batch._repr_html_()
    counts = dict(cells(batch._repr_html_()))["result"]
    assert sum(map(int, re.findall(r"\d+", counts))) == 2 and "step limit" in counts


def test_signatures_name_their_types():
    for name in (name for name in udk.__all__ if callable(getattr(udk, name))):
        found = getattr(udk, name)
        has_one = not inspect.isclass(found) or not issubclass(found, Exception | int)
        for argument in inspect.signature(found).parameters.values() if has_one else ():
            text = str(argument).replace("typing.Union", "")  # by which older Python versions write |
            assert "numpy.bool" not in text and len(text) < 330, (name, argument)


def test_the_help_of_a_body_begins_on_one_screen():
    import pydoc

    text = pydoc.plain(pydoc.render_doc(udk.Body))
    own = text[: text.index("Method resolution order")]  # signature, what it is, and its arguments
    assert len(own.splitlines()) <= 30 and "mass: Numbers" in own
