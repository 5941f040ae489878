"""Mobility, redundancy, branches and rank changes, compared with closed forms, exact arithmetic and hand-written Jacobians."""

import json
from fractions import Fraction
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pytest import approx
from scipy.optimize import brentq
from scipy.sparse import csr_array

import udkjax as udk
from tests.calls import calls_of
from tests.scaling import scaled
from udkjax.pinv.sparse_gram import SmallSingularValues
from udkjax.scene import GROUND
from udkjax.study.accuracy import pendulum
from udkjax.study.diagnosis import fix_search
from udkjax.study.diagnosis.configuration import RankedPositions

COS, SIN = Fraction(3, 5), Fraction(4, 5)
ANGLE = float(np.arctan2(4.0, 3.0))


@jax.jit
def psi_q(mechanism, q):
    return udk.equations.psi_q(mechanism, 0.0, q)


def exact_rank(matrix: list[list[Fraction]]) -> int:
    """The rank by elimination with rational numbers."""
    rows, rank = [list(row) for row in matrix], 0
    for column in range(len(rows[0])):
        pivot = next((k for k in range(rank, len(rows)) if rows[k][column]), None)
        if pivot is None:
            continue
        rows[rank], rows[pivot] = rows[pivot], rows[rank]
        for k in range(rank + 1, len(rows)):
            factor = rows[k][column] / rows[rank][column]
            rows[k] = [a - factor * b for a, b in zip(rows[k], rows[rank], strict=True)]
        rank += 1
    return rank


def exact_jacobian(mechanism, rotations: dict[str, tuple[Fraction, Fraction]], names=None) -> list[list[Fraction]]:
    """Psi_q of revolute joints in rational numbers. `rotations` are cos and sin of each body's angle."""
    places = {name: k for k, name in enumerate(mechanism.body_names)}
    rational = lambda x: Fraction(round(float(x) * 10**6), 10**6)  # noqa: E731
    matrix = []
    for joint in (mechanism.joints[name] for name in names or mechanism.joints):
        rows = [[Fraction(0)] * (3 * len(places)) for _ in range(2)]
        for sign, body, point in zip((-1, 1), joint.bodies, joint.points, strict=True):
            if body != GROUND:
                (c, s), (x, y), k = rotations[body], map(rational, point), 3 * places[body]
                rows[0][k], rows[0][k + 2] = Fraction(sign), -sign * (s * x + c * y)
                rows[1][k + 1], rows[1][k + 2] = Fraction(sign), sign * (c * x - s * y)
        matrix += rows
    return matrix


def double_parallelogram(angles=(ANGLE, ANGLE)):
    """Two stages of three parallel links each: 24 rows of rank 22, two degrees of freedom."""
    c, s = np.cos(angles), np.sin(angles)
    bodies, joints, base = {}, {}, np.zeros(2)
    below = GROUND
    for stage in range(2):
        e = np.array([c[stage], s[stage]])
        platform = f"platform{stage}"
        for k, x in enumerate((-1.0, 0.0, 1.0)):
            link = f"link{stage}{k}"
            bodies[link] = udk.Body(1.0, 0.1, base + [x, 0.0] + e / 2, angles[stage])
            joints[f"A{stage}{k}"] = udk.Revolute([below, link], [[x, 0.0], [-0.5, 0.0]])
            joints[f"B{stage}{k}"] = udk.Revolute([platform, link], [[x, 0.0], [0.5, 0.0]])
        base = base + e
        bodies[platform] = udk.Body(2.0, 0.2, base)
        below = platform
    return udk.Mechanism(bodies, joints, name="double parallelogram")


def doubled():
    plain = udk.library.four_bar()
    return udk.Mechanism(plain.bodies, {**plain.joints, "again": plain.joints["B"]}, name="doubled")


@pytest.fixture(scope="module")
def found(linkage):
    return udk.diagnose(linkage)


def test_freedoms_and_redundancy_of_the_paper_s_linkage(found):
    assert (found.coordinates, found.rows, found.gruebler) == (12, 12, 0)
    assert (found.rank, found.ordinary_rank, found.degrees_of_freedom, found.redundant) == (11, 11, 1, 1)
    (redundancy,) = found.redundancies
    assert redundancy.constraints == ("A1", "A2", "A3", "B1", "B2", "B3") and redundancy.count == 1 and redundancy.permanent
    assert not found.is_singular and not found.timeline
    # The self-stress (1, -2, 1) along the links: nothing across them is open.
    for name, forces in found.forces.items():
        assert_allclose(forces.direction, np.pi / 4, atol=1e-9)  # across -45 degrees
        assert_allclose(forces.share, np.sqrt(0.5 / 12) * (2 if name[1] == "2" else 1), atol=1e-9)


def test_every_fix_of_the_paper_s_linkage_leaves_its_motion_and_takes_the_redundancy(linkage, found):
    """A slot along the link, in any of the six pins: one degree of freedom, nothing redundant, and the same accelerations."""
    fixes = found.redundancies[0].fixes
    assert {fix.constraint for fix in fixes} == set(linkage.joints)
    a = np.asarray(udk.accelerations(linkage, 0.0, linkage.q0, linkage.v0))
    for fix in (fixes[0], fixes[-1]):
        assert "slot along 0 degrees of" in fix.change and fix.removes == 1
        analysis = udk.analyse(fix.mechanism)
        assert analysis.redundant == () and analysis.degrees_of_freedom == 1
        assert udk.diagnose(fix.mechanism, fixes=False, walk=False).redundancies == ()
        assert_allclose(udk.accelerations(fix.mechanism, 0.0, linkage.q0, linkage.v0), a, atol=1e-10)


def test_the_next_rank_change_of_the_paper_s_linkage_is_where_its_links_lie_in_line(found):
    """From -45 degrees to 0 three links turn: their centres and the coupler's move on arcs."""
    nearest = found.clearance.nearest
    assert nearest is not None and nearest.rank == 10
    assert_allclose(nearest.q[:, 2], 0.0, atol=1e-8)
    way = np.pi / 4 * np.sqrt(3 * (0.25 + 1) + 1)  # of q, lengths over one metre; chords are a little shorter than the arc
    assert_allclose(nearest.distance, way, rtol=1e-3)


def test_the_estimate_is_sigma_over_its_slope_along_the_motion(linkage, found, placed):
    """The slope is a difference of NumPy's singular values along theta."""
    h, scale = 1e-4, np.sqrt(3 * 1.25 + 1)

    def sigma(theta):
        return np.linalg.svd(psi_q(linkage.without_origin, placed(theta, 0.0)[0]), compute_uv=False)[10]

    slope = (sigma(-np.pi / 4 + h) - sigma(-np.pi / 4 - h)) / (2 * h * scale)
    assert_allclose(found.clearance.estimate, sigma(-np.pi / 4) / abs(slope), rtol=1e-6)
    assert_allclose(found.singular_values, np.linalg.svd(psi_q(linkage.without_origin, linkage.q0))[1], atol=1e-13)


def test_in_line_the_paper_s_linkage_has_one_branch_and_two_mobilities():
    """The second order excludes the direction (1, 0, -1) of the links; one motion, (1, 1, 1), remains."""
    found = udk.diagnose(udk.library.parallelogram(0.0), fixes=False)
    assert (found.rank, found.ordinary_rank, found.mobility, found.degrees_of_freedom) == (10, 11, 2, 1)
    assert found.is_singular and [r.permanent for r in found.redundancies] == [True, False]
    (branch,) = found.branches
    assert branch.followed and branch.rank == 11 and branch.degrees_of_freedom == 1
    assert_allclose(branch.tangent, [[0, 0.5, 1]] * 3 + [[0, 1, 0]], atol=1e-7)
    assert found.clearance.smallest == 0.0


def test_branches_of_square_four_bars_in_line():
    """a (b - a) = 0 for each: one has the parallelogram (1, 1) and fold (0, 1); two have (1, 1, 1), (0, 1, 1) and (0, 0, 1)."""
    one = udk.diagnose(udk.library.n_four_bar(1, 0.0))
    assert {tuple(np.round(b.tangent[:2, 2] / b.tangent[1, 2], 6)) for b in one.branches} == {(1.0, 1.0), (0.0, 1.0)}
    assert all(branch.followed for branch in one.branches)
    two = udk.diagnose(udk.library.n_four_bar(2, 0.0))
    links = {tuple(np.round(b.tangent[:3, 2] / b.tangent[2, 2], 6)) for b in two.branches}
    assert links == {(1.0, 1.0, 1.0), (0.0, 1.0, 1.0), (0.0, 0.0, 1.0)}
    assert (two.rank, two.ordinary_rank, two.degrees_of_freedom) == (12, 14, 1)
    sets = {frozenset(r.constraints): r.permanent for r in two.redundancies}
    assert sets == {frozenset({"A0", "A1", "B0", "C0"}): False, frozenset({"A1", "A2", "B1", "C1"}): False}
    assert not any(r.fixes for r in two.redundancies)  # elsewhere nothing is redundant


def test_a_duplicated_joint_is_removed():
    found = udk.diagnose(doubled())
    assert found.gruebler == -1 and found.degrees_of_freedom == 1
    (redundancy,) = found.redundancies
    assert redundancy.constraints == ("B", "again") and redundancy.count == 2
    assert {fix.constraint: (fix.change, fix.removes) for fix in redundancy.fixes} == {
        "B": ("remove it", 2),
        "again": ("remove it", 2),
    }
    assert found.cured is not None and udk.analyse(found.cured).redundant == ()
    assert not any(found.forces["again"].unique) and all(found.forces["C"].unique)


def test_a_double_parallelogram_in_exact_arithmetic():
    """Each stage has its own six pins: rank 22, by rational elimination at 3-4-5; also for each set without a pin."""
    mechanism = double_parallelogram()
    rotations = {n: (COS, SIN) if n.startswith("link") else (Fraction(1), Fraction(0)) for n in mechanism.body_names}
    exact = exact_jacobian(mechanism, rotations)
    assert_allclose(np.array(exact, float), psi_q(mechanism.without_origin, mechanism.q0), atol=1e-12)
    assert exact_rank(exact) == 22
    found = udk.diagnose(mechanism, fixes=False)
    assert (found.gruebler, found.rank, found.degrees_of_freedom) == (0, 22, 2)
    sets = [r.constraints for r in found.redundancies]
    assert sorted(map(set, sets), key=sorted) == [{f"{kind}{stage}{k}" for kind in "AB" for k in range(3)} for stage in range(2)]
    for names in sets:
        rows = exact_jacobian(mechanism, rotations, names)
        assert exact_rank(rows) == len(rows) - 1
        for name in names:  # minimal: without any of them nothing is redundant
            rest = exact_jacobian(mechanism, rotations, [n for n in names if n != name])
            assert exact_rank(rest) == len(rest)


@pytest.mark.parametrize("unit", [1e-6, 1e3])
def test_a_micrometre_and_a_kilometre_get_the_same_diagnosis(found, linkage, unit):
    other = udk.diagnose(scaled(linkage, unit))
    plain, small = found.to_dict(), other.to_dict()
    for key in ("rank", "gruebler", "degrees_of_freedom", "mobility", "singular"):
        assert plain[key] == small[key]
    for one, two in zip(plain["redundancies"], small["redundancies"], strict=True):
        assert (one["constraints"], one["count"], one["permanent"]) == (two["constraints"], two["count"], two["permanent"])
        assert {(f["constraint"], f["change"]) for f in one["fixes"]} == {(f["constraint"], f["change"]) for f in two["fixes"]}
    assert_allclose(small["singular_values"], plain["singular_values"], atol=1e-12)
    for name, forces in plain["forces"].items():
        assert forces["unique"] == small["forces"][name]["unique"]
        assert_allclose(small["forces"][name]["share"], forces["share"], atol=1e-9)
    assert_allclose(small["clearance"]["nearest"]["distance"], plain["clearance"]["nearest"]["distance"], rtol=1e-6)
    assert small["clearance"]["nearest"]["rank"] == 10
    in_line = udk.diagnose(scaled(udk.library.n_four_bar(1, 0.0), unit), fixes=False, walk=False)
    assert len(in_line.branches) == 2 and in_line.rank == 7


def exact_crossings(linkage, start, end):
    """When the links of the paper's linkage are in line, by its elliptic solution: theta = 0 and pi, modulo a turn."""
    times, J, w = np.linspace(0.0, end, 4001), 3.05, 3.5
    theta = lambda t: start + pendulum(np.atleast_1d(t), start + np.pi / 2, 0.0, np.sqrt(w * 9.81 / J))[0]  # noqa: E731
    values = np.sin(start + pendulum(times, start + np.pi / 2, 0.0, np.sqrt(w * 9.81 / J)))
    changes = np.flatnonzero(values[:-1] * values[1:] < 0)
    return np.array([brentq(lambda t: np.sin(theta(t)), times[k], times[k + 1], xtol=1e-14) for k in changes])


def test_rank_changes_along_a_motion_are_bracketed_at_their_exact_times():
    """Released at +45 degrees the linkage passes 0 and pi. The 40 outputs are a tenth of a second apart."""
    mechanism = udk.library.parallelogram(np.pi / 4)
    solution = udk.simulate(mechanism, np.linspace(0.0, 4.0, 41), rtol=1e-11, atol=1e-11)
    line = udk.diagnose(mechanism, solution=solution, fixes=False, walk=False).timeline
    expected = exact_crossings(mechanism, np.pi / 4, 4.0)
    assert line is not None and len(expected) >= 4
    assert [change.rank for change in line.changes] == [10] * len(expected)
    assert_allclose([change.time for change in line.changes], expected, atol=2e-8)
    assert all(c.earliest < c.time < c.latest and c.latest - c.earliest < 1e-8 and c.smallest < 1e-6 for c in line.changes)
    assert np.all(line.rank == 11) and line.closest[1] < 1e-6


def test_a_trajectory_that_stays_clear_has_no_rank_change(linkage):
    """Swinging from -45 degrees the links come no nearer to being in line than at the start. Any states will do."""
    ts = np.linspace(0.0, 3.0, 61)
    solution = udk.simulate(linkage, ts, rtol=1e-9, atol=1e-9)
    states: Any = SimpleNamespace(ts=ts, q=solution.q, v=solution.v)
    line = udk.diagnose(linkage, solution=states, fixes=False, walk=False).timeline
    assert line is not None and line.changes == ()
    assert_allclose(line.closest[1], line.smallest[0], rtol=1e-3)


def test_a_shaky_structure_moves_to_first_order_only():
    """A bob between two collinear rods: mobility one, no motion."""
    rods = {name: udk.Distance(["ground", "bob"], [[x, 0.0], [0.0, 0.0]]) for name, x in (("left", -1.0), ("right", 1.0))}
    found = udk.diagnose(udk.Mechanism({"bob": udk.Body(1.0, 1.0)}, {**rods, "turn": udk.Angle(["ground", "bob"])}))
    assert (found.mobility, found.degrees_of_freedom, found.branches) == (1, 0, ())
    assert found.is_singular and not found.redundancies[0].permanent and not found.redundancies[0].fixes


def test_drivers_that_ask_for_the_same_are_found():
    """Two motors turn one crank, and one would be enough. The degrees of freedom that drivers control are printed."""
    plain = udk.library.slider_crank(0.7)
    mechanism = udk.Mechanism(plain.bodies, plain.joints, {**plain.drivers, "second": plain.drivers["motor"]})
    found = udk.diagnose(mechanism, walk=False)
    (redundancy,) = found.redundancies
    assert redundancy.constraints == ("motor", "second") and redundancy.permanent
    assert {fix.change for fix in redundancy.fixes} == {"remove it"}
    assert (found.joint_mobility, found.mobility, found.gruebler) == (1, 0, -1)


def test_a_linkage_with_its_own_rank_change_between_limits():
    """Peaucellier's arms and sides are in line at 2 acos((arm - side) / (2 crank)). The walk passes this angle and finds it."""
    found = udk.diagnose(udk.library.peaucellier())
    nearest = found.clearance.nearest
    assert nearest is not None
    assert_allclose(abs(nearest.q[0, 2]), 2 * np.arccos(0.8 / 1.2), atol=1e-6)


def test_texts_say_what_was_found(found):
    text = str(found)
    for words in (
        "Gruebler's count: 3 x 4 bodies - 12 rows (constraint equations) = 0",
        "rank 11 = 1",
        "A1, A2, A3, B1, B2, B3",
        "slot along 0 degrees",
    ):
        assert words in text
    assert "only the component along 45 degrees is unique" in text and "five-bar parallelogram" in text
    assert found._repr_html_().startswith("<table>") and "Gruebler&#x27;s count" in found._repr_html_()
    data = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert data["rank"] == 11 and len(data["redundancies"][0]["fixes"]) == 6


def test_an_empty_scene_and_a_free_body_have_nothing_to_say():
    free = udk.diagnose(udk.Mechanism({"body": udk.Body(1.0, 1.0)}))
    assert free.degrees_of_freedom == free.gruebler == 3 and free.redundancies == ()
    assert "Gruebler's count: 3 x 1 body - 0 rows (constraint equations) = 3" in str(free)


def test_traced_numbers_are_refused():
    mechanism = udk.library.parallelogram()

    def ask(mass):
        udk.diagnose(mechanism.with_parameters({"body.coupler.mass": mass}))
        return mass

    with pytest.raises(ValueError, match="concrete numbers"):
        jax.jit(ask)(1.0)


def test_mechanisms_are_built_for_the_fixes_that_are_named():
    """Two braced cells of six bars: each bar has a fix. Of the second step only the best one is verified."""
    bodies = {f"{k}{i}": udk.Body(1.0, 0.01, [float(k), float(i)]) for k in range(3) for i in (0, 1)}
    pairs = [(f"{k}{i}", f"{k + 1}{j}") for k in (0, 1) for i in (0, 1) for j in (0, 1)] + [(f"{k}0", f"{k}1") for k in range(3)]
    joints: dict[str, Any] = {f"{a} {b}": udk.Distance([a, b], [[0.0, 0.0]] * 2) for a, b in pairs}
    joints["pin"] = udk.Revolute([GROUND, "00"], [[0.0, 0.0]] * 2)
    with calls_of(fix_search.apply_change) as built:
        found = udk.diagnose(udk.Mechanism(bodies, joints), walk=False)
    assert len(found.redundancies) == 2 and len(found.cure) == 2
    assert found.cured is not None and udk.analyse(found.cured).redundant == ()
    assert len(built) == len({fix.constraint for r in found.redundancies for fix in r.fixes}) + 1


def umbrella(ribs):
    """A runner on a pole opens pairs of ribs by stretchers; the ribs of one side lie on each other and share their pins."""
    rib, at, stretcher, a = 500.0, 200.0, 240.0, np.deg2rad(60.0)
    low = 400 - at * np.cos(a)
    pins = {"N": (0, 400), "R": (0, low - np.sqrt(stretcher**2 - (at * np.sin(a)) ** 2))}
    links: dict[str, Any] = {"runner": {"pins": ["R"], "mass": 0.05, "width": 30}}
    for k in range(ribs):
        for sign, side in ((1, "r"), (-1, "l")):
            pins |= {f"J{side}": (sign * at * np.sin(a), low), f"T{side}": (sign * rib * np.sin(a), 400 - rib * np.cos(a))}
            links[f"rib{side}{k}"] = {"pins": ["N", f"J{side}", f"T{side}"], "mass": 0.04, "width": 5}
            links[f"stretcher{side}{k}"] = {"pins": ["R", f"J{side}"], "mass": 0.02}
    return udk.Drawing(pins, links, ["N"], {"pole": {"link": "runner", "direction": [0, 1]}}, units={"length": "mm"}).mechanism()


def test_many_redundant_sets_are_advised_in_a_line_each_with_few_decompositions(monkeypatch):
    """Each change was tried by a decomposition of the Jacobian in each position, and by building the mechanism anew."""
    decompose, large = np.linalg.svd, []

    def counted(matrix, *given, **choices):
        large.append(min(np.shape(matrix)[-2:]) > 10)
        return decompose(matrix, *given, **choices)

    mech = umbrella(2)
    udk.diagnose(mech, walk=False, fixes=False)
    monkeypatch.setattr(np.linalg, "svd", counted)
    with calls_of(RankedPositions.__init__) as ranked:
        found = udk.diagnose(mech, walk=False)
    assert len(ranked) == 1 and sum(large) < 900
    assert sum(r.count for r in found.redundancies) == sum(fix.removes for fix in found.cure) == 8
    assert found.cured is not None
    cured = udk.diagnose(found.cured, walk=False)
    assert cured.redundancies == () and cured.degrees_of_freedom == found.degrees_of_freedom == 1
    for r in found.redundancies:  # each fix is one: the decomposition of the changed mechanism says so
        after = [udk.diagnose(fix.mechanism, fixes=False, walk=False) for fix in r.fixes[:1]]
        assert [(x.redundant, x.degrees_of_freedom) for x in after] == [(8 - fix.removes, 1) for fix in r.fixes[:1]]
        assert after[0].conditioning == approx(1 / r.fixes[0].conditioning, rel=0.5)
    text = str(found)
    assert len(text) < 400 * len(found.redundancies)
    assert all(f"  {', '.join(r.constraints)}: " in text for r in found.redundancies)
    assert "in each of these" in text and "remove any of them" in text


def test_positions_of_a_large_scene_are_closed_and_ranked_without_dense_decompositions(monkeypatch):
    """The walk to the next rank change takes hundreds of positions, which are all kept; their Jacobians are sparse."""
    mech, decompose, found = udk.library.n_four_bar(20), np.linalg.svd, []
    positions = RankedPositions(mech, 1e-6)
    start = positions.at(0.0, np.ravel(udk.assemble(mech).q))
    direction = start.right[:, 0]

    def counted(matrix, *given, **choices):
        found.append(min(matrix.shape) > 10)
        return decompose(matrix, *given, **choices)

    monkeypatch.setattr(np.linalg, "svd", counted)
    moved = positions.displace(start, direction, 0.1)
    assert moved is not None and moved.rank == start.rank and not any(found)
    assert np.abs(positions.rows.residual(0.0, moved.q)).max() < 1e-12
    assert moved.allowed(direction) == approx(moved.right @ (moved.right.T @ direction), abs=1e-12)
    assert [moved.value(moved.rank), moved.largest] == approx(moved.sigma[[moved.rank - 1, 0]], abs=1e-14)


@pytest.mark.parametrize("redundant", [0, 3, 40])
def test_small_singular_values_of_a_sparse_matrix_are_those_of_the_dense_one(redundant):
    random = np.random.default_rng(1)
    A = random.standard_normal((60, 90)) * (random.uniform(size=(60, 90)) < 0.1)
    A = np.concatenate([A, random.standard_normal((redundant, 60)) @ A])
    small, sigma = SmallSingularValues(csr_array(A), 1e-9), np.linalg.svd(A)[1]
    assert small.zero_count == redundant and small.largest == approx(sigma[0], rel=1e-11)
    assert small.values[redundant] == approx(sigma[59], rel=1e-12)
    assert small.left.T @ small.left == approx(np.eye(redundant), abs=1e-12)
    assert np.abs(small.left.T @ A).max(initial=0.0) < 1e-12 * sigma[0]
    x = random.standard_normal(90)
    assert small.null_space_part(x) == approx(x - np.linalg.pinv(A, rcond=1e-9) @ (A @ x), abs=1e-9)


def test_singular_values_of_more_rows_than_columns_from_those_of_a_similar_matrix():
    """The vectors of the first matrix, one for each of its rows, are more than the second one has singular values."""
    random = np.random.default_rng(2)
    A = random.standard_normal((25, 15))
    B = A + 1e-6 * random.standard_normal(A.shape)
    small = SmallSingularValues(csr_array(B), 1e-9, SmallSingularValues(csr_array(A), 1e-9).vectors)
    assert small.zero_count == 10 and small.values[10] == approx(np.linalg.svd(B)[1][-1], rel=1e-11)
    assert np.abs(small.left.T @ B).max() < 1e-12 * small.largest
