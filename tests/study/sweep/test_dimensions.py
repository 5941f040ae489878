"""Axes become dimensions. Every mistake is named, with a suggested correction."""

from itertools import pairwise

import diffrax
import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.study.sweep.axes import scale_to_range
from udkjax.study.sweep.dimensions import lay_out
from udkjax.study.sweep.fingerprint import fingerprint
from udkjax.study.sweep.measures import MeasureChoice
from udkjax.study.sweep.plan import make_plan

TS = [0.0, 1.0]
CONSTANT = diffrax.ConstantStepSize()


def problems(mechanism, axes, measure="final", **arguments):
    with pytest.raises(udk.SweepError) as raised:
        make_plan(mechanism, axes, TS, measure, **arguments)
    return raised.value.problems


def test_a_grid_has_its_axes_as_dimensions_and_zipped_ones_share_one(linkage):
    axes = {
        "body.link1.mass": [1.0, 2.0, 3.0],
        "both": udk.Zipped({"rtol": [1e-4, 1e-8], "method": [udk.SVD(), udk.Varga()]}),
        "tol": udk.Axis([1e-9], of=["atol", "rank_tol"]),
    }
    dimensions = lay_out(linkage, axes)
    assert [(d.name, d.size, [c.name for c in d.columns]) for d in dimensions] == [
        ("body.link1.mass", 3, ["body.link1.mass"]),
        ("both", 2, ["rtol", "method"]),
        ("tol", 1, ["tol"]),
    ]
    assert dimensions[0].columns[0].units == "kg"
    plan = make_plan(linkage, axes, TS)
    assert plan.size == 6 and plan.shape == (3, 2, 1)
    assert plan.places(np.array([0, 3, 5]))["method"].tolist() == [0, 1, 1]
    assert [group.members.tolist() for group in plan.groups] == [[0, 2, 4], [1, 3, 5]]
    assert [group.labels for group in plan.groups] == [{"method": "SVD"}, {"method": "Varga"}]


def test_choices_that_differ_by_numbers_share_a_program(linkage):
    axes = {
        "stabilization": [udk.Baumgarte(0.0, 0.0), udk.Baumgarte(1000.0, 100.0), None],
        "mechanism": [udk.library.parallelogram(angle) for angle in (-0.7, -0.5)],
    }
    plan = make_plan(linkage, axes, TS)
    assert [len(group.members) for group in plan.groups] == [4, 2]
    (column, mechanisms) = plan.columns
    assert column.labels == ("Baumgarte(alpha=0, beta=0)", "Baumgarte(alpha=1000, beta=100)", "none")
    assert mechanisms.labels == ("five-bar parallelogram", "five-bar parallelogram #2")


def test_controllers_and_solvers_fit_together(linkage):
    """Zipped, each solver has its own controller; labels show the numbers that differ."""
    controllers = [diffrax.PIDController(tol, 1e-9) for tol in (1e-4, 1e-6)]
    how = {"solver": [diffrax.Euler(), diffrax.Tsit5(), None], "stepsize_controller": [CONSTANT, *controllers]}
    plan = make_plan(linkage, {"how": udk.Zipped(how), "dt0": [1e-3, 1e-4]}, TS)
    assert plan.columns[1].labels == ("ConstantStepSize", "PIDController(rtol=0.0001)", "PIDController(rtol=1e-06)")
    assert [len(group.members) for group in plan.groups] == [2, 2, 2]
    assert "0x" not in str(fingerprint(plan))
    alone = make_plan(linkage, {"dt0": [1e-3, 1e-4]}, TS, solver=diffrax.Euler(), stepsize_controller=CONSTANT)
    assert alone.columns[0].units == "s" and len(alone.groups) == 1


@pytest.mark.parametrize("design", [udk.Sobol(16, seed=3), udk.LatinHypercube(16, seed=3), udk.Random(16, seed=3)])
def test_a_design_fills_ranges_and_distributions_and_repeats_itself(linkage, design):
    axes = {"body.link1.mass": (1.0, 3.0), "rtol": scipy.stats.loguniform(1e-8, 1e-4), "method": [udk.SVD(), udk.Varga()]}
    member, method = lay_out(linkage, axes, design)
    assert (member.name, member.size, method.size) == ("member", 16, 2)
    mass, rtol = (column.numbers for column in member.columns)
    assert np.all((mass > 1) & (mass < 3) & (rtol > 1e-8) & (rtol < 1e-4)) and len(set(mass)) == 16
    again = lay_out(linkage, axes, design)[0].columns[0].numbers
    assert_allclose(again, mass, rtol=0)
    assert not np.allclose(lay_out(linkage, axes, type(design)(16, seed=4))[0].columns[0].numbers, mass)


def test_a_latin_hypercube_has_one_member_in_each_part():
    unit = udk.LatinHypercube(50).unit(3)
    assert np.all(np.sort(np.floor(50 * unit), axis=0) == np.arange(50)[:, None])
    assert scale_to_range((2.0, 1.0), unit[:, 0]) is None


@pytest.mark.parametrize(
    ("axes", "arguments", "message"),
    [
        ({"body.lnik1.mass": [1.0]}, {}, 'is neither a parameter of the mechanism nor a setting; did you mean "body.link1.mass"'),
        ({"rtool": [1.0]}, {}, 'did you mean "rtol"'),
        ({"body.link1.mass": [1.0, -1.0]}, {}, "mass: must be > 0, not -1.0"),
        ({"gravity": [1.0, 2.0]}, {}, "gravity: must have the shape (2,), not ()"),
        ({"rtol": [1e-4, np.nan]}, {}, "must be finite numbers"),
        ({"rtol": []}, {}, "needs at least one value"),
        ({"alpha": [1.0]}, {"stabilization": None}, "alpha belongs to stabilization=Baumgarte()"),
        ({"rtol": [1e-4]}, {"rtol": 1e-3}, "rtol is both a setting and an axis"),
        ({"rtol": [1e-4], "tol": udk.Axis([1e-3], of="rtol")}, {}, 'axes "rtol" and "tol" both set "rtol"'),
        ({"z": udk.Zipped({"rtol": [1e-4], "atol": [1e-4, 1e-3]})}, {}, "zipped axes must have equally many values"),
        ({"rtol": scipy.stats.loguniform(1e-8, 1e-4)}, {}, "a distribution needs a design"),
        ({"rtol": [1e-8, 1e-6, 1e-4]}, {"design": udk.Sobol(4)}, "values must be a range (low, high)"),
        ({"method": [udk.SVD()]}, {"design": udk.Sobol(4)}, "no axis is a range"),
        ({"time": udk.Axis([1e-8], of="rtol")}, {}, "choose another"),
        ({"tolerance": udk.Axis([1e-8], of="rtol")}, {}, "data.sel(tolerance=...) of xarray has another meaning; choose another"),
        ({"self": udk.Axis([1e-8], of="rtol")}, {}, "data.sel(self=...) of xarray has another meaning; choose another"),
        ({"method": [udk.SVD()], "pseudoinverse": udk.Axis([1e-8], of="rtol")}, {}, 'the dimension of "method" has this name'),
        ({"alpha": [1.0, np.nan]}, {}, "alpha must be finite numbers"),
        ({"z": udk.Zipped({"alpha": [1.0, np.nan], "stabilization": [None, udk.Baumgarte()]})}, {}, "NaN is for members without"),
        ({}, {}, "a sweep needs at least one"),
        ({"rtol": [1e-4]}, {"derivatives": ["body.link1.mas"]}, 'did you mean "body.link1.mass"'),
        ({"rtol": [1e-4]}, {"derivatives": ["gravity"]}, 'is not a single number; name an entry, such as "gravity[0]"'),
        ({"rtol": [1e-4]}, {"throw": True}, "a sweep has no such setting"),
        ({"rtol": [1e-4]}, {"measure": "finl"}, 'did you mean "final"'),
        ({"rtol": [1e-4]}, {"measure": "error"}, 'measure "error" needs reference='),
        ({"rtol": [1e-4]}, {"measure": "error", "reference": np.zeros((3, 4, 3))}, "coordinates at the 2 output times"),
        ({"rtol": [1e-4]}, {"reference": np.zeros((2, 4, 3))}, 'is used by the measure "error" only'),
        ({"stepsize_controller": [None, CONSTANT]}, {}, 'axis "stepsize_controller": stepsize_controller: constant steps need'),
        ({"rtol": [1e-4]}, {"solver": diffrax.Euler()}, "solver: steps follow from estimated errors"),
        (
            {"solver": [diffrax.Euler(), diffrax.Heun()]},
            {"dt0": 0.1},
            'axis "solver": solver: steps follow from estimated errors',
        ),
        ({"dt0": [0.0, 1e-3]}, {"stepsize_controller": CONSTANT}, "dt0 must be positive and finite, not 0"),
    ],
)
def test_mistakes_are_named(linkage, axes, arguments, message):
    (problem,) = problems(linkage, axes, **arguments)
    assert message in problem


@pytest.mark.parametrize(
    ("axes", "measure", "name"),
    [
        ({"q_end": udk.Axis([1e-8], of="rtol")}, "final", "q_end"),
        ({"z": udk.Zipped({"v_end": udk.Axis([1e-8], of="rtol")})}, "final", "v_end"),
        ({"rtol": [1e-4]}, lambda mechanism, solution: {"rtol": solution.q[-1, 0, 0]}, "rtol"),
        ({"rtol": [1e-4]}, lambda mechanism, solution: {"body": solution.q[-1, 0, 0]}, "body"),
    ],
)
def test_a_variable_and_an_axis_have_different_names(linkage, axes, measure, name):
    """Otherwise the dataset has one of the two alone."""
    with pytest.raises(udk.SweepError, match=f'"{name}" is both a variable of a measure and an axis'):
        udk.sweep(linkage, axes, TS, measure=measure, progress=False)


def test_all_mistakes_are_named_at_once(linkage):
    assert len(problems(linkage, {"a": [1.0], "b": [2.0]}, "c", derivatives=["d"], progress=True)) == 5
    with pytest.raises(ValueError, match='engine must be one of "auto", "devices", "dask", not "gpu"'):
        udk.sweep(linkage, {"rtol": [1e-4]}, TS, engine="gpu")  # pyright: ignore[reportArgumentType]


def test_gains_are_varied_of_a_stabilization_that_has_some(linkage):
    assert isinstance(make_plan(linkage, {"alpha": [1.0, 2.0]}, TS).settings["stabilization"], udk.Baumgarte)


def test_the_fingerprint_tells_what_decides_the_results(linkage):
    def of(values=(1e-4, 1e-6), measure: MeasureChoice = "final", mechanism=linkage, factor=2.0, **settings):
        length = udk.Axis([1.0], of=lambda m, x: m.with_parameters({"body.coupler.mass": factor * x}))
        return fingerprint(make_plan(mechanism, {"rtol": values, "x": length}, TS, measure, **settings))

    def last(power):
        return {"angle": lambda m, s: s.q[-1, 0, 2] ** power}

    base = of()
    assert of() == base
    assert of(measure=last(2)) == of(measure=last(2)) != of(measure=last(3))
    others = [
        of((1e-4, 1e-7)),
        of(measure="counts"),
        of(mechanism=udk.library.parallelogram(mass=1.5)),
        of(factor=3.0),
        of(atol=1e-9),
        of(method=udk.SVD()),
        of(method=udk.SVD(1e-8)),
        of(stabilization=udk.Baumgarte(2.0)),
        of(derivatives=["body.link1.mass"]),
    ]
    assert all(base != other for other in others) and all(a != b for a, b in pairwise(others))


def four_bar_of(crank, coupler, rocker, ground):
    pins = {
        "O": (0, 0),
        "C": (ground, 0),
        "A": udk.polar("O", crank, 1.0),
        "B": udk.circles(("A", "C"), (coupler, rocker), "left"),
    }
    links = {name: {"pins": ends, "mass": 1.0, "width": 0.01} for name, ends in (("a", "OA"), ("b", "AB"), ("c", "CB"))}
    return udk.Drawing(pins, {name: link | {"pins": list(link["pins"])} for name, link in links.items()}, ["O", "C"]).mechanism()


def test_numbers_of_a_drawing_are_checked_together_and_members_that_cannot_be_drawn_are_data():
    scene, longer = four_bar_of(0.04, 0.12, 0.08, 0.1), np.array([1.0, 10.0])
    axes = {"pin.C[0]": 0.1, "pin.A.length": 0.04, "pin.B.length[0]": 0.12, "pin.B.length[1]": 0.08}
    scaled = udk.Zipped({name: x * longer for name, x in axes.items()})
    data = udk.sweep(scene, {"size": scaled}, [0.0, 0.1], ["final"], progress=False)
    alone = udk.simulate(four_bar_of(0.4, 1.2, 0.8, 1.0), [0.0, 0.1])
    assert np.all(data.result == 0)
    np.testing.assert_allclose(data.q_end[1], alone.q[-1], rtol=1e-6)
    data = udk.sweep(scene, {"pin.A.length": [0.04, 0.4]}, [0.0, 0.1], ["final"], progress=False)
    assert data.result.values.tolist() == [udk.Result.successful, udk.Result.invalid_argument]
    with pytest.raises(udk.SweepError, match=r'axis "pin.A.length": pins.A.length: must be > 0, not -1'):
        udk.sweep(scene, {"pin.A.length": [0.04, -1.0]}, [0.0, 0.1])
