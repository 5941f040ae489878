"""Runs by other formulations end where the Udwadia-Kalaba equation does, or say why not."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.equations import equations_of
from udkjax.integrate.constrained import Constrained
from udkjax.integrate.diffrax_engine import derivative
from udkjax.study.accuracy import exact_coordinates, pendulum

FORMULATIONS = {
    "Augmented": udk.Augmented(),
    "NullSpaceQR": udk.NullSpaceQR(),
    "NullSpaceSVD": udk.NullSpaceSVD(),
    "CoordinatePartitioning": udk.CoordinatePartitioning(),
}
ROBUST = FORMULATIONS | {"Augmented": udk.Augmented(udk.SVD())}
TS = np.linspace(0.0, 2.0, 9)


every = pytest.mark.parametrize("formulation", FORMULATIONS.values(), ids=FORMULATIONS)


def tsit5(mech, formulation, ts=TS, tol=1e-9, **choices):
    return udk.simulate(mech, ts, rtol=tol, atol=tol, solver=diffrax.Tsit5(), formulation=formulation, **choices)


def exact(mech, sol):
    found = exact_coordinates(mech, sol.ts, sol.q[0], sol.v[0])
    assert found is not None
    return found


@pytest.fixture(scope="module")
def swinging():
    """A four-bar with a spring and a damper, and its motion."""
    bare = udk.library.four_bar()
    names = list(bare.bodies)
    spring = udk.Spring(["ground", names[1]], [[0.2, 1.5], [0.1, 0.0]], stiffness=8.0, length=0.5, damping=0.4)
    mech = udk.Mechanism(bare.bodies, bare.joints, bare.drivers, {"spring": spring})
    return mech, tsit5(mech, None)


# --- the same motion


@pytest.mark.slow
@every
@pytest.mark.parametrize("stabilization", [udk.Projection(), udk.Baumgarte()])
def test_a_regular_mechanism(swinging, formulation, stabilization):
    if isinstance(formulation, udk.CoordinatePartitioning) and isinstance(stabilization, udk.Baumgarte):
        pytest.skip("refused: see tests/equations/test_formulations.py")
    mech, reference = swinging
    sol = tsit5(mech, formulation, stabilization=stabilization)
    assert jnp.abs(reference.q - reference.q[0]).max() > 0.3
    assert_allclose(sol.q, reference.q, atol=2e-7)
    assert_allclose(sol.v, reference.v, atol=2e-6)
    assert sol.settings["formulation"] == type(formulation).__name__


@pytest.mark.slow
@every
def test_a_driven_mechanism(data, table, formulation):
    """No degree of freedom is left: there are no independent coordinates, and nothing is integrated but time."""
    ts, row = table(data("slider_crank_constant_speed")["reference"])
    sol = tsit5(udk.library.slider_crank(), formulation, ts)
    assert_allclose(sol.q[:, 1, 2], row["phi"], atol=1e-11)
    assert_allclose(sol.v[:, 2, 0], row["xd"], atol=1e-11)


# --- partitioning


LINKAGE = udk.library.parallelogram(np.deg2rad(-50))


def of_rod(mech, sol):
    """The exact motion of a rod of 1.5 m that swings from 60 degrees."""
    phi = np.pi / 3 + pendulum(sol.ts, np.pi / 3, 0.0, np.sqrt(9.81))
    return np.stack([0.75 * np.sin(phi), -0.75 * np.cos(phi), phi - np.pi / 2], 1)[:, None]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mech", "expected"), [(udk.library.compound_pendulum(), of_rod), (LINKAGE, exact)], ids=["pendulum", "linkage"]
)
def test_constraints_hold_without_stabilization(mech, expected):
    """Positions and velocities satisfy them to machine precision at every output, and the motion is exact."""
    sol = tsit5(mech, udk.CoordinatePartitioning(), stabilization=None)
    assert_allclose(sol.q, expected(mech, sol), atol=2e-8)
    equations = equations_of(mech)
    rest = jax.jit(jax.vmap(equations.violation))(TS, sol.q.reshape(len(TS), -1), sol.v.reshape(len(TS), -1))
    assert max(float(jnp.abs(r).max()) for r in rest) < 1e-13
    assert sol.settings["stabilization"] == "NoneType"


@pytest.mark.slow
def test_only_what_is_independent_is_judged():
    """With this step size the error is large in one coordinate and its velocity; in the others it is zero."""
    mech = LINKAGE
    equations = equations_of(mech, None, None, udk.CoordinatePartitioning())
    y0 = jnp.concatenate([mech.q0.ravel(), mech.v0.ravel()])
    solver, term = Constrained(diffrax.Tsit5(), True), diffrax.ODETerm(derivative)

    @eqx.filter_jit
    def step(dt):
        state = solver.init(term, 0.0, dt, y0, equations)
        y1, tally, *_ = solver.step(term, 0.0, dt, y0, equations, state, False)
        return y1, tally.error

    y1, error = step(jnp.array(0.2))
    independent = equations.fix_partition(0.0, *jnp.split(y0, 2)).independent
    assert independent is not None and int(independent.sum()) == 2
    assert_allclose(error[~independent], 0.0, atol=0)
    assert (jnp.abs(error[independent]) > 1e-10).all()
    assert jnp.abs(equations.violation(0.2, *jnp.split(y1, 2))[0]).max() < 1e-13
    _, lost = step(jnp.array(5.0))  # no prediction from which Newton's method finds back to this assembly
    assert np.isnan(lost).any()


@pytest.mark.slow
def test_a_multistep_method():
    """Its errors are those of independent components, and it keeps its history when other components become independent."""
    mech = LINKAGE
    reference = tsit5(mech, udk.CoordinatePartitioning(), stabilization=None)
    sol = udk.simulate(mech, TS, rtol=1e-9, atol=1e-9, solver=udk.Adams(), formulation=udk.CoordinatePartitioning())
    assert_allclose(sol.q, reference.q, atol=1e-7)
    assert sol.stats["right_hand_sides"] < reference.stats["right_hand_sides"]


@pytest.mark.slow
def test_batches_gradients_and_traced_numbers(placed):
    """Forward mode compared with differences, under vmap and jit."""
    mech = udk.library.parallelogram(np.deg2rad(-50))

    def angle(p):
        state = udk.State(*placed(p[0], 0.0))
        changed = mech.with_parameters({"gravity": jnp.stack([0.0, -p[1]])})
        return tsit5(changed, udk.CoordinatePartitioning(), TS[:3], 1e-10, state=state, adjoint=diffrax.ForwardMode()).q[-1, 0, 2]

    points = jnp.array([[-0.9, 9.81], [-0.6, 5.0]])
    values, slopes = jax.jit(jax.vmap(lambda p: (angle(p), jax.jacfwd(angle)(p))))(points)
    single, h = jax.jit(angle), 1e-4
    for p, value, slope in zip(points, values, slopes, strict=True):
        assert_allclose(value, single(p), atol=1e-9)
        differences = [(single(p + h * e) - single(p - h * e)) / (2 * h) for e in jnp.eye(2)]
        assert_allclose(slope, differences, atol=1e-6)


# --- where plain LU ends


def test_plain_LU_on_redundant_rows():
    """A joint is given twice. The first right-hand side is NaN, and the run says so."""
    single = udk.library.compound_pendulum()
    mech = udk.Mechanism(single.bodies, {"pin": single.joints["pin"], "again": single.joints["pin"]})
    with pytest.raises(udk.SimulationError, match=r"not finite at t = 0 s: .*plain LU, and they are singular: 4 rows of rank 2"):
        tsit5(mech, udk.Augmented())


LONG = np.linspace(0.0, 20.0, 81)


STARTS = {"ordinary": (-50, 0.0), "45": (45, 0.0), "in line": (0, 0.0), "up": (90, -1.0)}  # angle (deg), rate (rad/s)
starts = pytest.mark.parametrize(("angle", "rate"), STARTS.values(), ids=STARTS)


@pytest.mark.slow
@starts
@pytest.mark.parametrize("formulation", ROBUST.values(), ids=ROBUST)
def test_twenty_seconds(formulation, angle, rate):
    """The last three starts cross singular configurations, where 10 of 12 rows are independent instead of 11."""
    mech = udk.library.parallelogram(np.deg2rad(angle), rate)
    sol = udk.simulate(mech, LONG, rtol=1e-9, atol=1e-9, formulation=formulation, max_steps=5000)
    assert np.abs(exact(mech, sol) - sol.q).max() < 2e-6
    assert jnp.abs(udk.violation(mech, sol)).max() < 1e-12


@starts
def test_plain_LU_ends_where_it_begins(angle, rate):
    """The pivot of the redundant row is zero or a rounding error, for all starts that differ by rounding."""
    mech = udk.library.parallelogram(np.deg2rad(angle), rate)
    random, q = np.random.default_rng(0), np.asarray(mech.q0)
    q = q + np.spacing(np.abs(q)) * random.choice([-1, 0, 1], (24, *q.shape))
    choices = {"rtol": 1e-9, "atol": 1e-9, "formulation": udk.Augmented(), "max_steps": 5000, "throw": False}
    sols = jax.jit(jax.vmap(lambda q: udk.simulate(mech, LONG, udk.State(q, mech.v0), **choices)))(q)
    assert np.all(sols.code == udk.Result.not_finite) and not np.any(sols.time)
    assert not np.any(sols.stats["steps"]) and not np.any(sols.stats["accepted"])
