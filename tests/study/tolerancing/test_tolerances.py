"""Samples agree with closed forms of the mechanism, moments with those of polynomials, and tolerances that cost least."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import udkjax as udk
from tests.command_line import udkjax
from udkjax.synthesis.ranges.deviations import grade
from udkjax.synthesis.ranges.second_order import quadratic

SWING = "range(body.rocker.angle)"


@pytest.fixture(scope="module")
def four_bar():
    return udk.library.four_bar()  # links of 1, 2.5, 2 m, and 2.5 m of ground


def rocker_angle(a, b, c, d, crank):
    """Return the angle of the rocker of a four-bar with ground link d along x, from its diagonal, in the open branch."""
    x, y = a * np.cos(crank) - d, a * np.sin(crank)
    diagonal = np.hypot(x, y)
    return np.arctan2(y, x) - np.arccos((c**2 + diagonal**2 - b**2) / (2 * c * diagonal))


def test_samples_are_those_of_the_closed_form(four_bar):
    tolerances = {"length(crank)": 0.003, "length(coupler)": udk.Tolerance(4.0, "mm", "uniform"), "length(rocker)": "5 mm"}
    values, measures = np.deg2rad(np.linspace(60, 400, 35)), ["max(body.rocker.angle)", "min(body.rocker.angle)"]
    found = udk.tolerances(four_bar, tolerances, measures, drive="body.crank.angle", values=values, samples=500, seed=3)
    normal = np.random.default_rng(3).standard_normal((500, 3))
    a, c = 1.0 + 0.001 * normal[:, 0], 2.0 + 0.005 / 3 * normal[:, 2]
    b = 2.5 + 0.004 * (2.0 * stats.norm.cdf(normal[:, 1]) - 1.0)
    nominal = np.asarray(udk.kinematics(four_bar, "body.crank.angle", values).q)[:, 2, 2]
    own = rocker_angle(1.0, 2.5, 2.0, 2.5, values)
    turns = np.round((nominal - own) / (2 * np.pi)) * 2 * np.pi
    assert np.allclose(own + turns, nominal, atol=1e-12)
    angle = rocker_angle(a[:, None], b[:, None], c[:, None], 2.5, values) + turns
    assert np.allclose(found.measured, np.stack([angle.max(1), angle.min(1)], 1), rtol=0, atol=1e-12)
    assert found.yield_ == 1.0
    assert 0 < found.standard_error < 0.01


def test_the_deviation_of_a_pin_is_the_distance_from_its_nominal_path(four_bar):
    values = np.deg2rad(np.linspace(60, 200, 15))
    motion = udk.kinematics(four_bar, "body.crank.angle", values)
    path = np.asarray(udk.path(four_bar, motion, "pin.C"))[:, :2]
    goal = udk.PathGoal("C", path, values=values)
    measures = {"C": "deviation(pin.C)", "goal": goal}
    found = udk.tolerances(four_bar, {"length(rocker)": "5 mm"}, measures, drive="body.crank.angle", values=values, samples=50)
    assert np.allclose(found.measured[:, 0], found.measured[:, 1], rtol=0, atol=1e-12)
    assert found.measured.max() > 1e-3
    assert found.nominal == pytest.approx([0.0, 0.0], abs=1e-12)


def test_moments_of_a_quadratic_function_are_exact(four_bar):
    names = ["link.crank.mass", "link.coupler.mass", "link.rocker.mass"]
    kinds = udk.Tolerance(0.3), udk.Tolerance(0.2, "", "uniform"), udk.Tolerance(0.1, "", "truncated", 2.0)

    def product(mech):
        a, b, c = (mech.parameters()[name] for name in names)
        return a * b + 3.0 * c**2

    found = udk.tolerances(four_bar, dict(zip(names, kinds, strict=True)), {"f": product}, samples=200_000)
    a, b = stats.norm(1.0, 0.1), stats.uniform(2.3, 0.4)
    moment = [stats.truncnorm(-2.0, 2.0, 2.0, 0.05).moment(k) for k in range(5)]
    mean = 2.5 + 3.0 * moment[2]
    variance = (1 + 0.01) * (2.5**2 + b.var()) - 2.5**2 + 9.0 * (moment[4] - moment[2] ** 2)
    assert found.second_order.mean["f"] == pytest.approx(mean, rel=1e-12)
    assert found.second_order.standard_deviation["f"] ** 2 == pytest.approx(variance, rel=1e-6)
    assert found.mean["f"] == pytest.approx(mean, abs=5 * (variance / 200_000) ** 0.5)
    assert found.standard_deviation["f"] ** 2 == pytest.approx(variance, rel=0.02)
    assert found.second_order.trusted["f"]
    shares = found.shares["f"]
    assert sum(share.first for share in shares.values()) < 1.0 < sum(share.total for share in shares.values())
    assert shares[names[0]].first == pytest.approx(a.var() * 2.5**2 / variance, rel=1e-6)


@pytest.mark.parametrize("sigmas", [0.5, 1.0, 3.0])
def test_truncated_distributions_have_their_moments(sigmas):
    tolerance, exact = udk.Tolerance(1.0, "", "truncated", sigmas), stats.truncnorm(-sigmas, sigmas)
    assert tolerance.spread == pytest.approx(exact.std() / sigmas, rel=1e-9)
    assert tolerance.kurtosis == pytest.approx(exact.moment(4) / exact.var() ** 2, rel=1e-8)
    u = tolerance.units(stats.norm.ppf((np.arange(20_000) + 0.5) / 20_000))
    assert np.std(u) == pytest.approx(1.0, rel=1e-3)
    assert np.abs(u).max() * tolerance.spread <= 1.0


@pytest.mark.parametrize(
    ("text", "length", "low", "high"),
    [("h9", 0.040, -62, 0), ("H7", 0.040, 0, 25), ("js8", 0.1, -27, 27), ("IT12", 0.003, -50, 50), ("h14", 0.5, -1550, 0)],
)
def test_grades(text, length, low, high):
    found = grade(text, length)
    assert found is not None
    assert found.limits == pytest.approx((low * 1e-6, high * 1e-6), rel=1e-12)


def sum_of_lengths(mech):
    points = [mech.parameters()[f"joint.{name}.points"] for name in "ABCD"]
    crank = jnp.linalg.norm(points[0][1] - points[1][0])
    return crank + jnp.linalg.norm(points[2][1] - points[3][1])


def test_shared_deviations_are_one(four_bar):
    one = udk.Tolerance(1.0, "mm", shared="jig")
    found = udk.tolerances(four_bar, {"length(crank)": one, "length(rocker)": one}, {"sum": sum_of_lengths}, samples=1000)
    assert found.nominal == pytest.approx([3.0])
    assert list(found.shares["sum"]) == ["jig"]
    assert found.second_order.standard_deviation["sum"] == pytest.approx(2e-3 / 3, rel=1e-9)


def test_the_play_of_a_pin_moves_it_by_the_clearance(four_bar):
    at, play = np.asarray(four_bar.parameters()["joint.B.points"])[1], {"B": udk.PinClearance("0.2 mm")}
    gap = {"gap": lambda mech: jnp.linalg.norm(mech.parameters()["joint.B.points"][1] - at)}
    assert np.allclose(udk.tolerances(four_bar, play, gap, samples=200).measured, 2e-4, rtol=1e-9)
    moved = udk.tolerances(four_bar, play, ["deviation(pin.C)"], drive="body.crank.angle", samples=300)
    assert 1e-4 < moved.measured.max() < 1e-3
    assert list(moved.shares["deviation(pin.C)"]) == ["clearance(B).x", "clearance(B).y"]


def test_the_cheapest_tolerances_are_those_of_the_closed_form(four_bar):
    """The tolerances of a linear measure with slopes g cost least with t^3 proportional to c / g^2."""
    names, slopes = ["link.crank.mass", "link.coupler.mass"], np.array([1.0, 4.0])

    def linear(mech):
        return sum(slope * mech.parameters()[name] for slope, name in zip(slopes, names, strict=True))

    limits = {"f": (11.0 - 0.05, 11.0 + 0.05)}
    found = udk.tolerances(four_bar, dict.fromkeys(names, 0.03), {"f": linear}, samples=100_000, limits=limits)
    best = found.cheapest(0.99, {names[1]: 3.0})
    factors = np.array([best.factors[name] for name in names])
    wanted = np.cbrt(np.array([1.0, 3.0]) / slopes**2)
    assert factors / factors[0] == pytest.approx(wanted / wanted[0], rel=0.1)
    exact = wanted * 0.05 / stats.norm.ppf(0.995) / np.hypot(*(slopes * 0.01 * wanted))
    cost = (np.array([1.0, 3.0]) / exact).sum() / 4.0
    assert best.cost == pytest.approx(cost, rel=0.01)
    spread = np.hypot(*(slopes * 0.01 * factors))
    assert 2.0 * stats.norm.cdf(0.05 / spread) - 1.0 == pytest.approx(0.99, abs=0.002)
    assert best.yield_ == pytest.approx(0.99, abs=0.003)
    assert best.deviations[names[0]][1] == pytest.approx(0.03 * factors[0], rel=1e-9)


def test_samples_that_cannot_turn_fail(four_bar):
    """The crank turns if it is shorter than the rocker, 2 m, as ground and coupler are equal."""
    mech = udk.with_length(four_bar, "crank", 1.98)
    values, width = np.deg2rad(np.linspace(60, 400, 69)), udk.Tolerance(0.1, "m", "uniform")
    found = udk.tolerances(mech, {"length(crank)": width}, ["max(body.rocker.angle)"], drive="body.crank.angle", values=values,
                           samples=400, seed=1)  # fmt: skip
    length = 1.98 + 0.1 * (2.0 * stats.norm.cdf(np.random.default_rng(1).standard_normal(400)) - 1.0)
    reached = np.isfinite(found.measured[:, 0])
    assert reached[length < 1.999].all()
    assert not reached[length > 2.01].any()
    assert found.yield_ == pytest.approx(1.0 - found.not_assembled) == pytest.approx(reached.mean())
    assert "do not reach" in str(found)


def test_a_run_is_a_measure(four_bar):
    def swing(mech):
        return udk.simulate(mech, [0.0, 0.05, 0.1], rtol=1e-8, atol=1e-8).q[-1, 0, 2]

    found = udk.tolerances(four_bar, {"link.coupler.mass": 0.3}, {"angle": swing}, samples=300, seed=5)
    masses = 2.5 + 0.1 * np.random.default_rng(5).standard_normal(300)
    wanted = [float(swing(four_bar.with_parameters({"link.coupler.mass": m}))) for m in masses[:3]]
    assert np.allclose(found.measured[:3, 0], wanted, rtol=1e-10)
    assert found.second_order.trusted["angle"]


def test_quadratic_of_a_polynomial():
    curvature = np.array([[2.0, 0.5], [0.5, -1.0]])

    def polynomial(u):
        return (1.0 + u @ [3.0, -2.0] + 0.5 * np.einsum("ni,ij,nj->n", u, curvature, u))[:, None]

    found, u = quadratic(polynomial, 2), np.random.default_rng(0).normal(size=(5, 2))
    assert np.allclose(found.slope, [[3.0, -2.0]])
    assert np.allclose(found.curvature, curvature)
    assert np.allclose(found(u), polynomial(u))


@pytest.mark.parametrize(
    ("tolerances", "measures", "limits", "words"),
    [
        ({"length(cranc)": 1e-3}, [SWING], {}, "cranc"),
        ({"length(crank)": -1e-3}, [SWING], {}, "positive"),
        ({"length(crank)": "1 kg"}, [SWING], {}, "kg"),
        ({"link.crank.mass": "h9"}, [SWING], {}, "grade of a length"),
        ({"length(crank)": "h3"}, [SWING], {}, "grades are 5 to 14"),
        ({"Q": udk.PinClearance(1e-4)}, [SWING], {}, "no joint"),
        ({"pin.C": 1e-3, "length(coupler)": 1e-3}, [SWING], {}, r"pin.C\[0\] changes length\(coupler\)"),
        ({}, [SWING], {}, "none is given"),
        ({"length(crank)": 1e-3}, [], {}, "none is given"),
        ({"length(crank)": 1e-3}, ["spread(body.rocker.angle)"], {}, "of a coordinate or a pin"),
        ({"length(crank)": 1e-3}, ["range(body.roker.angle)"], {}, "roker"),
        ({"length(crank)": 1e-3}, [SWING], {"rnge": 1.0}, "no measure"),
        ({"length(crank)": 1e-3}, [SWING], {SWING: (2, 1)}, "least and a larger"),
    ],
)
def test_bad_input_is_named(four_bar, tolerances, measures, limits, words):
    with pytest.raises((udk.SceneError, ValueError), match=words):
        udk.tolerances(four_bar, tolerances, measures, drive="body.crank.angle", limits=limits, samples=10)


def test_numbers_of_drivers_have_no_tolerance(four_bar):
    motor = udk.Driver(["ground", "crank"], "angle", udk.Polynomial([1.0, 2.0]))
    mech = udk.Mechanism(four_bar.bodies, four_bar.joints, {"motor": motor}, gravity=four_bar.gravity)
    with pytest.raises(udk.SceneError, match="prescribed by a driver"):
        udk.tolerances(mech, {"driver.motor.motion.coefficients": 0.1}, [SWING], samples=10)
    assert udk.tolerances(mech, {"length(rocker)": 1e-3}, [SWING], samples=10).yield_ == 1.0


def test_what_no_sample_meets_is_said(four_bar):
    found = udk.tolerances(four_bar, {"length(crank)": 1e-4}, [SWING], drive="body.crank.angle", limits={SWING: 0.5}, samples=50)
    assert found.yield_ == 0.0
    assert "No sample is within the limits" in str(found)
    with pytest.raises(ValueError, match="outside the limits without any deviation"):
        found.cheapest(0.9)


def test_what_varies_by_rounding_alone_has_no_shares():
    """The size of a drawing changes no angle."""
    mech = udk.Drawing(
        pins={"A": [0, 0], "B": udk.polar("A", "r", 60), "C": udk.circles("BD", ("3*r", "2*r"), "left"), "D": ["3*r", 0]},
        links={name: {"pins": list(ends), "mass": 1} for name, ends in (("crank", "AB"), ("rod", "BC"), ("rocker", "CD"))},
        ground=["A", "D"],
        motors={"motor": {"pin": "A", "speed": "60 rpm"}},
        units={"length": "mm", "angle": "deg"},
        numbers={"r": 40},
    ).mechanism()
    found = udk.tolerances(mech, {"number.r": 0.1}, ["range(body.rocker.angle)", "range(pin.C.x)"], samples=500, progress=False)
    angle, place = found.names
    assert found.shares[angle]["number.r"].total == 0.0 and found.second_order.trusted[angle]
    assert found.shares[place]["number.r"].total == pytest.approx(1.0)
    row = next(line for line in str(found).splitlines() if angle in line)
    assert row.split()[4] == "0" and row.endswith("no tolerance varies it") and "Not quadratic" not in str(found)


def test_numbers_are_read_and_printed_in_the_units_of_the_drawing(four_bar, tmp_path, capsys):
    """A four-bar drawn in mm and degrees is the one in SI units: plain texts are in mm, and so is what is printed."""
    pins = {"A": [0, 0], "B": [500, 866.0254037844386], "C": [2700.0, 1900.0], "D": [2500, 0]}
    links = {name: {"pins": list(ends), "mass": 1} for name, ends in (("crank", "AB"), ("coupler", "BC"), ("rocker", "CD"))}
    mech = udk.Drawing(pins=pins, links=links, ground=["A", "D"], units={"length": "mm", "angle": "deg"}).mechanism()
    measures = [SWING, "deviation(pin.C)"]
    given = {"length(crank)": ("2", 2e-3), "length(rocker)": ("+-3", 3e-3)}
    limits = {SWING: ("40", np.radians(40)), measures[1]: ("1.5", 1.5e-3)}
    texts, numbers = (
        udk.tolerances(
            mech,
            {k: x[n] for k, x in given.items()},
            measures,
            drive="body.crank.angle",
            values=[0.0, 0.1, 0.2],
            limits={k: x[n] for k, x in limits.items()},
            samples=2000,
        )
        for n in (0, 1)
    )
    assert np.array_equal(texts.measured, numbers.measured) and texts.yield_ == numbers.yield_
    swing, place = (line.split() for line in str(texts).splitlines()[2:4])
    assert swing[:3] == [SWING, "deg", f"{np.degrees(texts.nominal[0]):.6g}"]
    assert place[:2] == [measures[1], "mm"] and place[3] == f"{1e3 * texts.mean[measures[1]]:.6g}"
    best = texts.cheapest(0.9)
    assert f"length(crank)   {1e3 * best.deviations['length(crank)'][0]:.6g} mm" in str(best)
    udk.save(mech, scene := tmp_path / "scene.toml")
    tol, limit = (f"{name}=2" for name in ("length(crank)", measures[1]))
    assert udkjax("tolerances", scene, "--driver", "body.crank.angle", "--tol", tol, "--measure", measures[1], "--limit", limit,
                  "--samples", 500, "--cheapest", 0.9) == 0  # fmt: skip
    out = capsys.readouterr().out
    assert f"{measures[1]}  mm" in out and " mm\n" in out.split("cheapest")[1]


def test_a_plain_text_is_refused_where_its_unit_is_ambiguous():
    mech = udk.library.four_bar()
    drawn = udk.Drawing(
        pins={"A": [0, 0], "B": [10, 0], "C": [10, 10]}, links={"arm": {"pins": ["A", "B"], "mass": 1}}, ground=["A", "C"],
        units={"length": "mm"}, springs={"s": {"between": ["C", "B"], "stiffness": "3 N/mm"}},
    ).mechanism()  # fmt: skip
    with pytest.raises(udk.SceneError, match="needs a unit, as length is in mm here"):
        udk.tolerances(drawn, {"spring.s.stiffness": "5"}, {"f": lambda mech: mech.parameters()["spring.s.stiffness"]}, samples=9)
    assert "rad" in str(udk.tolerances(mech, {"length(crank)": "0.001"}, [SWING], drive="body.crank.angle", samples=9))
