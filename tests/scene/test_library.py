import inspect
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.core import Tracer
from numpy.testing import assert_allclose

import udkjax.scene as udk
from udkjax import simulate
from udkjax.equations.rows.dense_rows import DenseTerms
from udkjax.scene import library

ROOT = Path(__file__).parents[2]
# name: rows, rank of the Jacobian at the initial guess, what sets it in motion
MECHANISMS = {
    "parallelogram": (12, 11, {"angular_velocity": 1.3}),
    "n_four_bar": (14, 14, {}),
    "slider_crank": (9, 9, {"angle": 0.7}),
    "four_bar": (8, 8, {"angular_velocity": 1.3}),
    "simple_pendulum": (1, 1, {"velocity": (0.0, 1.0)}),
    "compound_pendulum": (2, 2, {"angular_velocity": 1.3}),
    "chain": (20, 20, {"angular_velocity": 1.3}),
    "double_pendulum": (4, 4, {"angular_velocities": (1.0, -2.0)}),
    "elliptic_trammel": (2, 2, {"angular_velocity": 1.3}),
    "driven_pendulum": (3, 3, {}),
    "scissor_lift": (16, 14, {"angular_velocity": 1.3}),
    "peaucellier": (20, 20, {"angular_velocity": 1.3}),
    "planetary_gear": (16, 14, {}),
    "excavator": (12, 12, {}),
    "andrews_squeezer": (20, 20, {}),
}
GEOMETRY = (
    "angle",
    "angles",
    "length",
    "lengths",
    "spacing",
    "position",
    "crank",
    "rod",
    "arm",
    "side",
    "ground",
    "sun",
    "planet",
)
AT_REST = ("andrews_squeezer",)  # by its publication


@pytest.mark.parametrize("name", MECHANISMS)
def test_it_starts_closed_and_with_velocities_that_its_constraints_allow(name):
    rows, rank, moving = MECHANISMS[name]
    mech = getattr(library, name)(**moving)
    terms, q, v = DenseTerms(mech), np.ravel(mech.q0), np.ravel(mech.v0)  # by NumPy: nothing is compiled
    psi_q, psi_t = terms.slopes(0.0, q)
    assert psi_q.shape == (rows, len(q))
    assert_allclose(terms.psi(0.0, q), 0.0, atol=2e-15)
    assert_allclose(psi_q @ v + psi_t, 0.0, atol=2e-15)
    assert np.linalg.norm(v) > 0.1 or name in AT_REST
    assert np.linalg.matrix_rank(psi_q, tol=1e-9) == rank


@pytest.mark.parametrize("name", MECHANISMS)
def test_the_example_file_is_the_library_s(name):
    mech, example = getattr(library, name)(), udk.load(ROOT / "examples" / f"{name}.toml")
    assert jax.tree.structure(example.without_origin) == jax.tree.structure(mech.without_origin)
    assert (example.drawing is None) == (mech.drawing is None)
    for key, value in example.parameters().items():  # a file says nothing of pins at rest
        assert_allclose(mech.parameters()[key], value, rtol=1e-14, atol=1e-14, err_msg=key)


def test_every_example_is_in_the_library():
    drawings = {"six_bar"}  # that are files alone
    assert {path.stem for path in (ROOT / "examples").glob("*.toml")} - drawings == set(library.__all__) == set(MECHANISMS)


def test_numbers_may_be_traced():
    start = jax.jit(lambda angle: library.parallelogram(angle=angle).q0)
    assert_allclose(start(0.3), library.parallelogram(0.3).q0, atol=1e-15)
    slope = jax.jacfwd(start)(0.3)
    assert_allclose(slope[3], [-np.sin(0.3), np.cos(0.3), 0.0], atol=1e-15)


def test_a_parallelogram_has_any_size():
    """Twice the lengths, four times the inertias and twice the gravity: twice the positions, and the same angles."""
    small, large = library.parallelogram(0.3, 1.2), library.parallelogram(0.3, 1.2, 2.0, 1.0, 0.4, 2.0, 0.8, 19.62, spacing=2.0)
    assert_allclose(large.q0, small.q0 * np.array([2.0, 2.0, 1.0]), atol=1e-15)
    assert_allclose(large.v0, small.v0 * np.array([2.0, 2.0, 1.0]), atol=1e-15)
    assert large.parameters()["joint.A3.points"][0].tolist() == [4.0, 0.0]


def _positions_are_traced(name, key, default):
    """True if a mechanism of the library has traced positions when the number `key` is traced."""
    found = []

    def build(value):
        found.append(isinstance(getattr(library, name)(**{key: value}).q0, Tracer))

    jax.eval_shape(build, jax.tree.map(float, default))
    return found[0]


@pytest.mark.parametrize("name", MECHANISMS)
def test_numbers_that_do_not_depend_on_a_traced_one_stay_concrete(name):
    for key, parameter in inspect.signature(getattr(library, name)).parameters.items():
        if not isinstance(parameter.default, int) and parameter.default is not None:
            assert _positions_are_traced(name, key, parameter.default) == (key in GEOMETRY), key


@pytest.mark.parametrize("name", ["slider_crank", pytest.param("peaucellier", marks=pytest.mark.slow)])
def test_traced_geometry_gives_the_same_numbers_by_jax_instead_of_numpy(name):
    build = getattr(library, name)
    key = next(key for key in inspect.signature(build).parameters if key in GEOMETRY)
    default = jax.tree.map(float, inspect.signature(build).parameters[key].default)
    for each, value in jax.jit(lambda x: build(**{key: x}).parameters())(default).items():
        assert_allclose(value, build().parameters()[each], rtol=1e-14, atol=1e-14, err_msg=each)


def test_slider_crank_starts_as_in_the_reference():
    data = json.loads((ROOT / "tests/data/slider_crank_constant_speed.json").read_text())["initial"]
    mech = library.slider_crank()
    assert_allclose(mech.q0.ravel(), data["q"], atol=1e-15)
    assert_allclose(mech.v0.ravel(), data["v"], atol=1e-15)
    assert not library.slider_crank(driven=False).drivers


def test_a_spring_holds_the_slider_of_a_slider_crank(at):
    """Stretched by 0.5 m from 1.5 m, with the slider moving away at v: V = 1/2 k 0.25, and the damper brakes it."""
    mech = library.slider_crank(angle=0.0, spring=(40.0, 1.5, 3.0))
    frames = at(mech, mech.q0, mech.v0 + jnp.array([[0.0] * 3, [0.0] * 3, [0.2, 0.0, 0.0]]))
    spring = mech.forces["spring"]
    ground, slider = (frames[name] for name in spring.bodies)
    assert_allclose(spring.potential(0.0, ground, slider), 5.0, rtol=1e-14)
    assert_allclose(spring.loads(0.0, ground, slider)[1], (-0.6, 0.0, 0.0), atol=1e-15)


@pytest.mark.slow
def test_the_excavator_is_in_equilibrium_on_its_cylinders(at):
    """With the free lengths of its springs, a rotation of boom, stick or bucket does not change the energy to first order."""
    start = library.excavator()
    lengths = {f"force.{name}.length": spring.length for name, spring in start.forces.items()}

    def energy(angles, gravity):
        mech = library.excavator(angles).with_parameters(lengths | {"gravity": jnp.stack([0.0, -gravity])})
        frames = at(mech, mech.q0, mech.v0)
        springs = sum(force.potential(0.0, *(frames[n] for n in force.bodies)) for force in mech.forces.values())
        return springs - sum(body.mass * (mech.gravity @ body.position) for body in mech.bodies.values())

    torques = jax.jit(jax.jacfwd(energy))
    angles = start.q0[jnp.array([0, 1, 4]), 2]
    assert_allclose(torques(angles, 9.81), 0.0, atol=1e-9 * 1.5e5)
    assert (jnp.abs(torques(angles, 0.0)) > 500.0).all()  # N m, without the weight


@pytest.mark.slow
@pytest.mark.parametrize("driven", [False, True])
def test_the_excavator_moves_for_20_s_without_a_singular_configuration(driven, psi):
    import udkjax

    mech = library.excavator(driven=driven)
    motion = udkjax.simulate(mech, np.linspace(0.0, 20.0, 401))
    jacobians = jax.jit(jax.vmap(lambda q, t: jax.jacfwd(lambda q: psi(mech, q, t))(q)))(motion.q, motion.ts)
    least = np.linalg.svd(np.reshape(jacobians, (401, -1, 15)), compute_uv=False)[:, -1]
    assert least.min() > 0.6 * least[0]
    turned = np.ptp(motion.q[..., 2], axis=0)
    assert (turned > (0.3 if driven else 0.02)).all(), turned
    assert_allclose(motion.q[0], mech.q0, atol=1e-9)


def test_n_four_bar_is_the_benchmark_s():
    mech = library.n_four_bar(40)
    assert len(mech.body_names) == 81
    assert len(mech.joints) == 121
    assert_allclose(mech.v0[0], [0.5, 0.0, -1.0], atol=1e-15)


def test_peaucellier_s_pin_is_on_the_line():
    for angle in (-1.2, 0.4, 1.5):
        mech = library.peaucellier(angle)
        side = mech.bodies["AD"]
        tip = side.frame().point((0.6, 0.0))
        assert_allclose(tip.x, (2.0**2 - 1.2**2) / (2 * 0.6), rtol=1e-13)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_planets_and_stages_can_be_counted(count, psi):
    for mech in (library.planetary_gear(count), library.scissor_lift(count), library.n_four_bar(count)):
        assert_allclose(psi(mech, mech.q0), 0.0, atol=5e-15)


def test_andrews_squeezer_moves_as_published():
    """The angles at 0.03 s of the Test Set for Initial Value Problem Solvers: beta, theta, gamma, phi, delta, omega, epsilon."""
    published = [15.81077119629904, -15.75637105984298, 0.04082224013073101, -0.5347301163226948, 0.5244099658805304]
    published += [0.5347301163226948, 1.048080741042263]
    motion = simulate(library.andrews_squeezer(), [0.0, 0.03], rtol=1e-12, atol=1e-12)
    k1, k2, k3, k4, k5, k6, k7 = np.asarray(motion.q[-1, :, 2])
    assert_allclose([k1, k2 - k1, k3, k4 - k5, k5, k6 - k7, k7], published, rtol=0, atol=2e-9)


@pytest.mark.parametrize("name", MECHANISMS)
def test_a_wrong_argument_is_named(name):
    """A text, NaN, no number or too many: each parameter of each mechanism refuses them by its name."""
    build = getattr(library, name)
    for parameter in inspect.signature(build).parameters.values():
        for value in ("text", float("nan"), [], np.ones(7), {"a": 1.0}, None):
            if value is not None or parameter.default is not None:
                with pytest.raises((TypeError, ValueError), match=rf"^{parameter.name}\b"):
                    build(**{parameter.name: value})


def test_links_that_do_not_meet_are_refused():
    with pytest.raises(ValueError, match="links of 1 and 10 m cannot meet"):
        udk.library.four_bar(lengths=(1.0, 1.0, 10.0))
    with pytest.raises(ValueError, match=r"a rod of 0[.]2 m does not reach"):
        udk.library.slider_crank(angle=1.5, rod=0.2)
