"""Results of `analyse`, independent of earlier imports and analyses."""

import subprocess
import sys

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.calls import calls_of
from tests.choices import fast
from udkjax.equations.programs import scales
from udkjax.equations.programs.scene_arrays import SceneArrays
from udkjax.equations.programs.scene_programs import _scene_programs as scene_program_cache
from udkjax.equations.programs.scene_programs import scene_programs
from udkjax.equations.rows import dense_rows, position_closure, position_rows, redundancy, sparse_rows
from udkjax.equations.terms import scale_program
from udkjax.equations.terms.structure import numbers_as_vector


def test_a_duplicated_joint_is_named():
    plain = udk.library.four_bar()
    first = next(iter(plain.joints))
    doubled = udk.analyse(udk.Mechanism(plain.bodies, {**plain.joints, "again": plain.joints[first]}))
    own = udk.analyse(plain)
    assert own.redundant == () and own.degrees_of_freedom == doubled.degrees_of_freedom == 1
    assert doubled.redundant == (("again", 0), ("again", 1)) and doubled.rank == own.rank  # the originals stay


def test_the_length_is_that_of_the_longest_arm_wherever_the_origin_is():
    mechanism = udk.library.parallelogram()
    assert_allclose(udk.analyse(mechanism).length, 1.0)  # the coupler's, from its centre of mass to a pin
    assert_allclose(udk.analyse(mechanism).time, np.pi * np.sqrt(1.0 / 9.81))  # of a swing of a pendulum as long
    away = {name: value + 1e3 for name, value in mechanism.parameters().items() if name.endswith("position")}
    pins = {f"joint.A{k}.points": np.asarray(mechanism.joints[f"A{k}"].points) + [[1e3, 1e3], [0.0, 0.0]] for k in (1, 2, 3)}
    moved = udk.analyse(mechanism.with_parameters(away | pins))
    assert_allclose(moved.length, 1.0, rtol=1e-12)
    assert moved.redundant_rows == udk.analyse(mechanism).redundant_rows


def test_what_the_rows_are_measured_by():
    """A row in metres changes by L if its body moves by L, one in radians by one, and a gear's by its radius."""
    gear = udk.analyse(udk.library.planetary_gear()).scales
    names = udk.analyse(udk.library.planetary_gear()).row_names
    block = udk.Mechanism({"block": udk.Body(1.0, 0.04)}, {"rail": udk.Prismatic(["ground", "block"], np.zeros((2, 2)), 0.0)})
    assert_allclose(udk.analyse(block).scales.rows, [0.2, 1.0])
    assert_allclose(udk.analyse(block).scales.weights, [1.0, 0.2])
    assert len(names) == len(gear.rows)


def test_masses_and_loads_decide_nothing_about_rows():
    """Mechanisms that differ only in masses and loads share the result."""
    mechanism = udk.library.parallelogram(-0.6)
    udk.analyse(mechanism)
    with calls_of(redundancy.examine_rows) as examined:
        for name in ("body.coupler.mass", "body.link1.inertia", "gravity"):
            changed = mechanism.with_parameters({name: 2.0 * mechanism.parameters()[name]})
            assert udk.analyse(changed).redundant_rows == udk.analyse(mechanism).redundant_rows
    assert examined == []


def test_a_traced_mechanism_has_the_rows_of_the_concrete_one_that_it_was_made_from_and_scales_of_its_own():
    """By machine code under jit, by NumPy or machine code under vmap alone; `grad` treats the rows as constant."""
    mechanism = udk.library.parallelogram()
    heavy = lambda mass: mechanism.with_parameters({"body.coupler.mass": mass, "body.coupler.inertia": mass})  # noqa: E731
    made, whole = jax.jit(lambda mass, whole: (udk.analyse(heavy(mass)), udk.analyse(whole)))(1e6, mechanism)
    assert made.redundant_rows == udk.analyse(mechanism).redundant_rows
    assert whole.redundant_rows is None and whole.rank is None and whole.row_names == made.row_names
    assert_scales(made.scales, heavy(1e6))
    assert_scales(whole.scales, mechanism)
    for members in (3, 40):
        masses = np.geomspace(1e-3, 1e6, members)
        found = jax.vmap(lambda mass: udk.analyse(heavy(mass)).scales)(masses)
        nested = jax.jit(jax.vmap(jax.vmap(lambda mass: udk.analyse(heavy(mass)).scales)))(masses[None])
        for k in (0, members - 1):
            assert_scales(jax.tree.map(lambda x, k=k: x[k], found), heavy(masses[k]))
            assert_scales(jax.tree.map(lambda x, k=k: x[0, k], nested), heavy(masses[k]))
    assert jax.grad(lambda mass: udk.analyse(heavy(mass)).scales.mass * mass)(90.0) == 90.0


def assert_scales(found, mechanism):
    for x, y in zip(found, udk.analyse(mechanism).scales, strict=True):
        assert_allclose(x, y, rtol=1e-14)


@pytest.mark.parametrize("count", [1, 30])
def test_bodies_that_nothing_holds_have_scales(count):
    """Without constraints, the scales follow from inertia and gravity: by NumPy for any number of bodies, and by machine code."""
    falling = udk.Mechanism({f"b{k}": udk.Body(2.0, 0.5, [float(k), 0.0]) for k in range(count)}, {})
    found = udk.analyse(falling)
    assert_allclose([found.length, found.mass, found.time], [0.5, 2.0, np.pi * np.sqrt(0.5 / 9.81)], rtol=1e-14)
    assert_scales(jax.jit(lambda whole: udk.analyse(whole).scales)(falling), falling)


@pytest.mark.parametrize("name", fast(["driven_pendulum"], ["planetary_gear", "driven_pendulum", "elliptic_trammel"]))
def test_scales_by_arrays_of_jax_and_by_machine_code_are_those_of_numpy(name):
    """Scenes with drivers, gears and force elements; JAX operations serve devices other than the CPU."""
    mechanism = getattr(udk.library, name)()
    programs, numbers = scene_programs(mechanism), np.array([*numbers_as_vector(mechanism.numbers), 0.0, 0.0])
    known = scales.scales_p.by_numpy(numbers, programs)
    assert_allclose(jax.jit(scales.scales_p.by_jax, static_argnums=1)(numbers, programs), known, rtol=1e-14)
    assert_scales(jax.jit(lambda whole: udk.analyse(whole).scales)(mechanism), mechanism)


def test_a_mechanism_made_while_something_is_traced():
    """Its plain numbers stay concrete. Redundant rows are known with traced masses and loads, but not with traced geometry."""
    seen = []

    def rail(mass, arm):
        """A block on a rail, held by two equal slots and a constraint on its angle."""
        slots = {name: udk.Slot(["ground", "block"], [[0.0, 0.0], [x * arm, 0.0]], 0.0) for name, x in (("one", -1), ("two", 1))}
        joints = {**slots, "angle": udk.Angle(["ground", "block"])}
        return udk.Mechanism({"block": udk.Body(mass, 0.1)}, joints, gravity=[mass, 0])

    @jax.jit
    def trace(x):
        made = [udk.library.parallelogram(), rail(1.0, 0.5), rail(x, 0.5), rail(1.0, x)]
        seen.extend((mechanism.is_concrete, udk.analyse(mechanism).redundant_rows) for mechanism in made)
        return x

    trace(1.5)
    assert [known for known, _ in seen] == [True, True, False, False]
    rows = udk.analyse(rail(1.0, 0.5)).redundant_rows
    assert rows is not None and len(rows) == 1
    assert [found for _, found in seen] == [udk.analyse(udk.library.parallelogram()).redundant_rows, rows, rows, None]


@pytest.mark.parametrize(
    "first", [pytest.param(name, marks=pytest.mark.slow) for name in ("udkjax", "udkjax.equations")] + ["udkjax.scene"]
)
def test_nothing_depends_on_the_order_of_imports(first):
    code = f"""
import {first}
from udkjax.scene import library
mechanism = library.parallelogram()
import udkjax as udk
print(udk.analyse(mechanism).redundant_rows, udk.accelerations(mechanism, 0.0, mechanism.q0, mechanism.v0)[0, 2])
"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split(") ")
    assert found[0] == "(9,"
    assert_allclose(float(found[1]), -3.5 * 9.81 * np.cos(-np.pi / 4) / 3.05, rtol=1e-12)


def row_of_cranks(count, speed, contradicted=False):
    """Cranks side by side, one with a redundant constraint, and a rod driven from 3.16 m that reaches the first up to 4 m."""
    bodies = {f"crank{k}": udk.Body(1.0, 0.1, position=[1.0 + 3 * k, 0.0]) for k in range(count)}
    joints = {f"pin{k}": udk.Revolute(["ground", f"crank{k}"], [[3 * k, 0.0], [-1.0, 0.0]]) for k in range(count)}
    joints["copy"] = joints["pin1"]
    rod = udk.Driver(["ground", "crank0"], "distance", udk.Polynomial([np.sqrt(10.0), speed]), [[0.0, 3.0], [0.0, 0.0]])
    held = {"held": udk.Driver(["ground", "crank0"], "angle", udk.Polynomial([0.0]))} if contradicted else {}
    return udk.Mechanism(bodies, joints, {"rod": rod} | held)


@pytest.mark.parametrize("large", [False, True])
def test_what_drivers_cannot_reach_is_given_up_soon(large):
    """The redundant rows are the same whether or not a driver reaches its values; contradictory drivers give None."""
    correction = type(redundancy.kinematic_rows(row_of_cranks(4, 1.0), large)).correction
    for speed, steps in ((1.0, 80), (100.0, 120), (-0.01, 120)):
        with calls_of(correction) as solved:
            assert redundancy.redundant_rows(row_of_cranks(4, speed), large) == (8, 9)
        assert 0 < len(solved) < steps, len(solved)
    with calls_of(correction) as solved:
        assert redundancy.redundant_rows(row_of_cranks(4, 1.0, contradicted=True), large) is None
    assert len(solved) < 400


def test_a_closure_computes_psi_once_at_each_position():
    mechanism = row_of_cranks(4, 1.0)
    rows = redundancy.kinematic_rows(mechanism)
    start = rows.close(0.0, np.asarray(mechanism.q0, float).ravel())
    assert start is not None
    seen: list[tuple[tuple[str, ...], bytes]] = []
    with calls_of(SceneArrays._run, begins=lambda given: seen.append((given["outputs"], given["q"].tobytes()))):
        closed = rows.close(0.0, start.q + 0.1 * np.random.default_rng(0).standard_normal(start.q.shape))
    assert closed is not None and len({q for _, q in seen}) > 3
    assert len(set(seen)) == len(seen)


MODULES = position_closure, position_rows, dense_rows, redundancy, scale_program, sparse_rows
DENSE = [
    "CLOSURE.tol",
    "CLOSURE.rounding",
    "CLOSURE.longest_step",
    "DEPENDENT_TOL",
    "CLEAR_TOL",
    "NEGLIGIBLE_SHARE",
    "HEADING_NOISE",
    "RANK_TOL",
    "MAX_MASS_RATIO",
]
SPARSE = ["DEPENDENT_PIVOT", "CLEAR_TOL", "NEGLIGIBLE_SHARE"]


@pytest.fixture
def written_anew():
    """Drop the programs of scenes, which contain thresholds."""

    def forget():
        scale_program._kernel.cache_clear()
        scene_program_cache.cache_clear()

    forget()
    yield
    forget()


@pytest.mark.usefixtures("written_anew")
@pytest.mark.parametrize("factor", fast([10.0], [0.1, 10.0]))
@pytest.mark.parametrize(
    ("name", "large"), [*((name, False) for name in DENSE), *((name, True) for name in SPARSE)], ids=lambda x: str(x)
)
def test_ten_times_more_or_less_of_a_threshold_changes_nothing(monkeypatch, name, large, factor):
    """The same number of rows is redundant, and mechanisms that closed still close."""
    scenes = {kind: getattr(udk.library, kind)() for kind in ("parallelogram", "planetary_gear")}
    expected = {kind: udk.analyse(mechanism).redundant for kind, mechanism in scenes.items()}
    name, _, field = name.partition(".")
    homes = [module for module in MODULES if hasattr(module, name)]
    assert homes
    for module in homes:
        value = getattr(module, name)
        changed = value._replace(**{field: factor * getattr(value, field)}) if field else factor * value
        monkeypatch.setattr(module, name, changed)
    for kind, mechanism in scenes.items():
        rows = redundancy.redundant_rows(mechanism, large)
        assert rows is not None and len(rows) == len(expected[kind])
        own = scales.concrete_scales(mechanism)
        off = mechanism.q0.ravel() + 1e-3 * own.coordinates(3 * len(mechanism.bodies)) * np.cos(np.arange(mechanism.q0.size))
        closer = sparse_rows.SparseRows(mechanism) if large else dense_rows.DenseRows(mechanism, own)
        *_, psi, psi_dot, _ = closer.assemble(0.0, np.asarray(off), np.asarray(mechanism.v0).ravel())
        assert np.max(np.abs(psi) / np.asarray(own.rows)) < 1e-11 and np.abs(psi_dot).max() < 1e-9
