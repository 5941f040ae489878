"""Questions of states and motions have the same answers by NumPy, by machine code if asked often, and by JAX if traced."""

from types import SimpleNamespace

import equinox as eqx
import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.calls import calls_of
from tests.choices import fast
from tests.quantities import QUANTITIES, arguments
from tests.ten_times import multiplied
from udkjax.arrays import is_traced
from udkjax.expressions.loops.compiled_loops import compiled_at_many, compiled_loops

LOOPS = "expressions.loops.array_loops.WORTH_COMPILING"
OFTEN = LOOPS, f"{LOOPS}_AT_MANY", "equations.programs.eliminated_steps.USES_BEFORE_ELIMINATION"
TURN, RISING, TIMES = np.linspace(0.0, 2 * np.pi, 25), np.linspace(1.6, 4.0, 9), np.linspace(0.0, 1.0, 11)
ANGLES, BAUMGARTE = 1.0 + 0.2 * TIMES, udk.Baumgarte(3.0, 4.0)
BEYOND = np.append(ANGLES, [np.pi, 3.4])  # the singular position of the parallelogram, where branches meet, and beyond it
FOUR_BAR, CRANK, LINKAGE = udk.library.four_bar(), udk.library.slider_crank(), udk.library.parallelogram(np.deg2rad(45.0))
SPRUNG, LOADED = (
    udk.Mechanism(dict(m.bodies), dict(m.joints), forces={"spring": udk.TorsionSpring(["ground", body], 3.0, 0.2)})
    for m, body in ((FOUR_BAR, "crank"), (LINKAGE, "link1"))
)
RATES, WEIGHTS = np.where(np.arange(11) % 3 == 0, 0.0, 2.0), {"body.crank.angle": 1.0, "body.rocker.angle": 3.0}
BETWEEN = udk.Coordinate(["link1", "coupler"], "y", [[0.1, 0.2], [0.3, -0.1]], axis=0.4)
APART = udk.Coordinate(["ground", "link2"], "distance", [[0.3, -0.7], [0.1, 0.2]])


def states(mech: udk.Mechanism) -> tuple:
    """All quantities of states near the guess, the last of them lost."""
    random = np.random.default_rng(0)
    q, v = (np.asarray(mech.q0) + 0.05 * random.standard_normal((4, *mech.q0.shape)) for _ in range(2))
    q[-1] = v[-1] = np.nan

    def ask(q, v):
        history, at = SimpleNamespace(ts=np.linspace(0.0, 1.0, 4), q=q, v=v), (0.3, q[1], v[1])
        return (
            *(f(mech, history) for f in (udk.violation, udk.energy, udk.efforts)),
            udk.accelerations(mech, *at, multipliers=True, stabilization=BAUMGARTE),
            udk.reactions(mech, history, stabilization=BAUMGARTE),
            udk.reactions(mech, history, frame="joint", about="joint"),
            udk.unique_reactions(mech, history, frame="body"),
            *(f(mech, *at[:2]) for f in (udk.singular_values, udk.uniqueness)),
            [f(mech, *arguments(f, *at)) for f in QUANTITIES.values()],
        )

    return ask, (q, v), 1e-12


def travel(mech: udk.Mechanism, driver: str) -> tuple:
    return lambda g: udk.travel(mech.with_parameters({"gravity": [0.0, g]}), driver), (-9.81,), 1e-10


def efforts(mech: udk.Mechanism, times: np.ndarray, rate, *drivers, **weights) -> tuple:
    motion = None if rate is None else udk.kinematics(mech, f"body.{mech.body_names[0]}.angle", times, None, rate, 0.3)

    def ask(times):
        found = udk.inverse_dynamics(mech, times, motion, list(drivers) or None, weights)
        assert is_traced(found.residual) or np.max(found.residual) < 1e-12
        return found

    return ask, (times,), 1e-9


def reactions(mech: udk.Mechanism, motion: udk.Kinematics, lost: tuple = ()) -> tuple:
    given = eqx.tree_at(lambda x: x.q, motion, motion.q.at[np.array(lost, int), 0, 2].set(np.nan))

    def ask(g, motion):
        found = udk.reactions(mech.with_parameters({"gravity": [0.0, g]}), motion)
        assert is_traced(found) or all((np.isnan(x).all(1) == np.isin(np.arange(11), lost)).all() for x in jax.tree.leaves(found))
        return found

    return ask, (-9.0, given), 1e-10


QUESTIONS = {
    "states, redundant": lambda: states(udk.library.parallelogram()),
    "states, driven": lambda: states(udk.library.planetary_gear()),
    "states, loaded": lambda: states(udk.library.andrews_squeezer()),
    "states, unconstrained": lambda: states(udk.Mechanism({"a": udk.Body(1.0, 0.1, [0.5, 0.1])})),
    "positions of a full turn": lambda: (lambda s: udk.kinematics(FOUR_BAR, "body.crank.angle", s), (1.0 + TURN,), 1e-9),
    "positions in long steps": lambda: (lambda s: udk.kinematics(FOUR_BAR, "body.crank.angle", s), (1.0 + TURN[::5],), 1e-9),
    "positions up to a toggle": lambda: (lambda s: udk.kinematics(FOUR_BAR, "body.rocker.angle", s), (RISING,), 1e-9),
    "positions where branches meet": lambda: (lambda s: udk.kinematics(LINKAGE, "body.link1.angle", s), (0.3 + TURN,), 1e-9),
    "travel of a full turn": lambda: travel(FOUR_BAR, "body.crank.angle"),
    "travel up to toggles": lambda: travel(FOUR_BAR, "body.rocker.angle"),
    "travel where branches meet": lambda: travel(LINKAGE, "body.link1.angle"),
    "efforts of one driver": lambda: efforts(LOADED, BEYOND, 2.0, "body.link1.angle"),
    "efforts of three": lambda: efforts(LOADED, BEYOND, 2.0, *(f"body.link{k}.angle" for k in (1, 2, 3))),
    "efforts along lengths": lambda: efforts(LOADED, BEYOND, 2.0, BETWEEN, APART),
    "efforts of the only driver": lambda: efforts(CRANK, np.linspace(0.0, 1.0, 300), None),
    "efforts with weights": lambda: efforts(SPRUNG, ANGLES, RATES, *WEIGHTS, **WEIGHTS),
    "reactions of a four-bar": lambda: reactions(SPRUNG, udk.kinematics(SPRUNG, "body.crank.angle", ANGLES, rate=2.0)),
    "reactions beside a lost state": lambda: reactions(CRANK, udk.kinematics(CRANK, None, TIMES), (3,)),
    "reactions of a slider-crank": lambda: reactions(CRANK, udk.kinematics(CRANK, None, TIMES)),
    "rest": lambda: (lambda k: udk.equilibrium(SPRUNG.with_parameters({"force.spring.stiffness": k})), (2.9,), 1e-9),
    "modes": lambda: (lambda k: udk.modes(SPRUNG.with_parameters({"force.spring.stiffness": k})).s, (2.9,), 1e-9),
}
COMPILED = [name for name in QUESTIONS if name.split()[0] in ("travel", "reactions", "rest", "modes")]  # if asked often


def compare(known, found, rtol):
    assert jax.tree.structure(known) == jax.tree.structure(found)
    for x, y in zip(jax.tree.leaves(known), jax.tree.leaves(found), strict=True):
        assert isinstance(x, jax.Array) and (x.shape, x.dtype) == (y.shape, y.dtype)
        assert_allclose(x, y, rtol=rtol, atol=rtol * max(1.0, np.nanmax(np.abs(y), initial=0.0)))


@pytest.mark.parametrize("name", fast(["states, redundant", "efforts of one driver", "efforts along lengths"], QUESTIONS))
def test_jax_answers_as_numpy_does(name):
    ask, given, rtol = QUESTIONS[name]()
    compare(ask(*given), jax.jit(ask)(*given), rtol)


@pytest.mark.parametrize("name", fast([x for x in COMPILED if x.split()[0] in ("reactions", "modes")], COMPILED))
def test_machine_code_answers_as_numpy_does(name):
    ask, given, rtol = QUESTIONS[name]()
    known = ask(*given)
    with multiplied(0.0, *OFTEN), calls_of(compiled_loops, compiled_at_many) as compiled:
        found = [ask(*given) for _ in range(2)][-1]  # elimination is prepared after one use
    assert any(call.result is not None for call in compiled)
    compare(known, found, rtol)
