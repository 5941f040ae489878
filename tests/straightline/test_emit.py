"""Programs: optimization barriers, evaluation on floats, and the split into early and later."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from udkjax.straightline import Graph, Program, frontier, trace
from udkjax.straightline.barrier import BARRIERS_HOLD

X = np.array([0.3, -0.7, 1.1])
BARRIER = "optimization_barrier" if jax.__version_info__ >= BARRIERS_HOLD else "inlineable"


def test_barriers_have_derivatives_of_every_order(emit):
    x, f = jnp.asarray(X), lambda x: jnp.sin(x[0] * x[1]) * x[2] / x[1]
    program = emit(f, X, cut_every=2)
    g = lambda x: program(x)[0]  # noqa: E731
    for derivative in (jax.grad, jax.jacfwd, jax.hessian, lambda h: jax.jacrev(jax.jacrev(h))):
        np.testing.assert_allclose(derivative(g)(x), derivative(f)(x), rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(jax.vmap(g)(jnp.stack([x, -x])), jax.vmap(f)(jnp.stack([x, -x])), rtol=1e-14)


def without_pair(text: str) -> str:
    """A module without the function for sine and cosine, which has barriers of its own."""
    before, _, after = text.partition("func.func private @_sincos")
    return before + after.partition("func.func")[2]


@pytest.mark.parametrize("every", [None, 1, 2, 5, 100])
def test_barriers_change_nothing_but_their_number(emit, every):
    f = lambda x: jnp.sin(x) * x - jnp.cos(x[::-1]) / (1.0 + x * x)  # noqa: E731
    program = emit(f, X, cut_every=every)
    operations = len(program.program.order)
    text = without_pair(jax.jit(program.__call__).lower(jnp.asarray(X)).as_text())
    assert text.count(BARRIER) <= (operations // every if every else 0)
    assert (BARRIER in text) == (every is not None and every < operations)
    np.testing.assert_allclose(program(jnp.asarray(X))[0], f(X), rtol=1e-14)


def test_a_barrier_holds_only_what_is_used_later(emit):
    """A chain: each operation uses the one before, so that no barrier needs more than one value. A batch has twice as many."""
    program = emit(lambda x: jnp.sin(jnp.cos(jnp.sin(jnp.cos(jnp.sin(x))))), 0.3, cut_every=1)
    for run, x, number in ((program.__call__, 0.3, 2), (jax.vmap(program.__call__), jnp.ones(3), 5)):
        text = without_pair(jax.jit(run).lower(x).as_text())
        lines = [s for s in text.splitlines() if BARRIER in s]
        assert len(lines) == number
        assert all(line.rpartition(":")[2].rpartition("->")[2].count("tensor<") == 1 for line in lines)


def test_floats_are_evaluated_without_compiling():
    graph = Graph()
    x, y = (graph.input(name, "state") for name in "xy")
    f = lambda x, y: jnp.sqrt(jnp.sin(x) ** 2 + jnp.exp(jnp.tanh(y))) / jnp.cos(x - y)  # noqa: E731
    (result,) = trace(f, 0.1, 0.2)(graph, np.asarray(x, object), np.asarray(y, object))
    program = Program(graph, [x, y], [result.item()], cut_every=1)
    compiled, listening = [], True

    def listen(event: str, duration_secs: float, **_):
        if listening and "compile" in event:
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    (found,) = program([0.4, 0.9])
    assert type(found) is float
    assert found == pytest.approx(math.sqrt(math.sin(0.4) ** 2 + math.exp(math.tanh(0.9))) / math.cos(-0.5), rel=1e-14)
    assert compiled == []
    jax.jit(lambda x: x * 3.25 + 1.125)(2.0)
    listening = False
    assert compiled, "the listener would not have noticed"


def test_an_operation_is_traced_once_for_each_value_it_has(emit):
    """What the jaxpr of a program holds is what the program counts."""
    program = emit(lambda x: (x[0] - x[1]) * jnp.sin(x[2]) + (x[1] - x[0]) / x[2], X).program
    (call,) = jax.make_jaxpr(lambda values: program(values))([jnp.asarray(x) for x in X]).jaxpr.eqns
    names = sorted(e.primitive.name for e in call.params["jaxpr"].jaxpr.eqns)
    assert names == sorted(name for name, n in program.count().items() for _ in range(n))


@pytest.fixture
def split():
    """m and l are parameters, q the state: sqrt(m) l (q + 1 / m) + l^2, early by parameters alone."""
    graph = Graph()
    m, length = (graph.input(name, "parameter") for name in ("m", "l"))
    q = graph.input("q", "state")
    output = graph.sqrt(m) * length * (q + 1.0 / m) + length * length
    early = frontier(graph, [output], lambda node: node.depends <= {"parameter"})
    return Program(graph, [m, length], early), Program(graph, [*early, q], [output]), Program(graph, [m, length, q], [output])


def test_what_depends_on_parameters_alone_is_computed_early(split):
    prologue, later, whole = split
    assert prologue.count() == {"sqrt": 1, "mul": 2, "div": 1}
    assert later.count() == {"add": 2, "mul": 1}
    assert whole.count() == {"sqrt": 1, "mul": 3, "div": 1, "add": 2}


def test_the_frontier_holds_only_what_the_later_program_uses(split):
    prologue, later, whole = split
    assert len(prologue.outputs) == 3
    assert all(later.uses(s) for s in prologue.outputs)
    assert later([*prologue([4.0, 3.0]), 0.5]) == pytest.approx(whole([4.0, 3.0, 0.5]))


def test_an_output_that_is_early_itself_goes_through_the_frontier():
    graph = Graph()
    m, q = graph.input("m", "parameter"), graph.input("q", "state")
    outputs = [m * m, m * q, graph.constant(2.0)]
    early = frontier(graph, outputs, lambda node: node.depends <= {"parameter"})
    assert early == [m, m * m]
    assert Program(graph, [*early, q], outputs)([3.0, 9.0, 2.0]) == [9.0, 6.0, 2.0]


def entry(function, *xs) -> list[str]:
    """The calls that a compiled program makes."""
    text = jax.jit(function).lower(*xs).compile().as_text() or ""
    return [line for line in text.split("\nENTRY")[1].splitlines() if " call(" in line]


def test_what_is_computed_early_is_one_function_with_its_derivatives():
    """Of what is traced: results that depend on nothing of it are not among its."""
    graph = Graph()
    m, g = (graph.input(name, "parameter") for name in "mg")
    program = Program(graph, [m, g], [graph.constant(1.0) / graph.sqrt(m), g * g, m * g * 2.0])
    early = lambda m, g=None: program.early([m, 1.5 if g is None else g], [True, g is not None])  # noqa: E731
    plain = lambda m, g=1.5: [1.0 / jnp.sqrt(m), g * g, m * g * 2.0]  # noqa: E731
    (call,) = [e for e in jax.make_jaxpr(early)(0.7).eqns if e.primitive.name in ("jit", "pjit")]
    assert len(call.outvars) == 2
    total = lambda f: lambda *xs: sum(k * x for k, x in enumerate(f(*xs), 1))  # noqa: E731
    for xs in ((0.7,), (0.7, -1.2)):
        places = tuple(range(len(xs)))
        both = total(early), total(plain)
        for derived in (
            lambda f: f,
            lambda f, places=places: jax.jacfwd(f, places),
            lambda f, places=places: jax.grad(f, places),
            lambda f: lambda *some: jax.vmap(f)(*(x * jnp.arange(1.0, 4.0) for x in some)),
            lambda f, places=places: jax.hessian(f, places),
        ):
            found, expected = (jax.jit(derived(f))(*xs) for f in both)
            np.testing.assert_allclose(np.ravel(found), np.ravel(expected), rtol=1e-13)
    for function in (early, jax.jacfwd(early), lambda x: jax.vmap(early)(x * jnp.ones(3))):
        assert len(entry(function, 0.7)) == 1
    assert len(entry(jax.grad(total(early)), 0.7)) <= 2


@pytest.mark.parametrize("size", (1, 2))
def test_what_xla_knows_of_a_batch_can_be_given_to_one_function(size):
    """XLA finds out that some of what is given is known, and all alike, and then that a derivative needs none of it."""
    graph = Graph()
    m, n, g = (graph.input(name, "parameter") for name in "mng")
    program = Program(graph, [m, n, g], [m, -m, m * n, n / g, g * g])
    known = jnp.array([[0.25, 0.25], [4.0, 1.0], [3.0, 3.0]])

    @jax.jit
    def given(known, g):  # traced, so that it is XLA which evaluates it
        return jnp.sqrt(known)[:, :size], g * jnp.ones(size)

    def early(g):
        known_to_xla, moving = given(known, g)
        return jax.vmap(lambda m, n, g: program.early([m, n, g], [True] * 3))(known_to_xla[0], known_to_xla[1], moving)

    def plain(g):
        m, n = jnp.sqrt(known)[:2, :size]
        return [m, -m, m * n, n / g, g * g * jnp.ones(size)]

    for derived in (
        lambda f: f,
        jax.jacfwd,
        jax.jacrev,
        jax.hessian,
        lambda f: jax.grad(lambda g: f(g)[3] @ given(known, g)[0][2]),
        lambda f: lambda g: jax.vmap(f)(g * jnp.arange(1.0, 4.0)),
    ):
        np.testing.assert_allclose(*(np.asarray(jax.jit(derived(f))(0.7)) for f in (early, plain)), rtol=1e-14)
    assert len(entry(early, 0.7)) == 1


def test_functions_called_by_what_is_one_function_are_part_of_it():
    graph = Graph()
    m, n = (graph.input(name, "parameter") for name in "mn")
    result = [trace(f, 0.5)(graph, x)[0].item() for f in (jnp.sin, jnp.cos) for x in (m, n)]
    program = Program(graph, [m, n], result)
    early = lambda m: jnp.stack(program.early([m, m * m], [True, True]))  # noqa: E731
    expected = np.array([np.sin(0.7), np.sin(0.49), np.cos(0.7), np.cos(0.49)])
    np.testing.assert_allclose(jax.jit(early)(0.7), expected, rtol=1e-15)
    assert len(entry(early, 0.7)) == 1


def test_what_is_no_arithmetic_is_computed_early_as_it_is():
    graph = Graph()
    xs = [graph.input(k, "parameter") for k in range(3)]
    f = lambda x: jnp.sort(x) * 2.0  # noqa: E731
    (result,) = trace(f, X)(graph, np.array(xs, object))
    program = Program(graph, xs, list(result))
    early = lambda x: jnp.stack(program.early(list(x), [True] * 3))  # noqa: E731
    np.testing.assert_array_equal(jax.jit(early)(X), f(X))
    assert not entry(early, X)


def test_what_opaque_nodes_take_can_be_replaced():
    graph = Graph()
    m = np.array([graph.input(k, "parameter") for k in range(3)], object)
    q = graph.input("q", "state")
    (ordered,), bent = trace(jnp.sort, jnp.asarray(X))(graph, m), trace(jnp.tanh, 0.5)(graph, q * m[1])
    outputs = [ordered[2] * q, ordered[0] + bent[0].item()]
    found = graph.replaced(outputs, {m[1].index: -q, q.index: q + 1.0})
    values = [*map(float, X), 0.4]
    expected = Program(graph, [*m, q], outputs)([values[0], -0.4, values[2], 1.4])
    assert Program(graph, [*m, q], found)(values) == pytest.approx(expected)


def test_an_early_opaque_node_hands_over_its_results():
    graph = Graph()
    m = np.array([graph.input(k, "parameter") for k in range(3)], object)
    q = graph.input("q", "state")
    (ordered,) = trace(jnp.sort, jnp.asarray(X))(graph, m)
    outputs = [ordered[2] * q, ordered[0] + q]
    early = frontier(graph, outputs, lambda node: node.depends <= {"parameter"})
    prologue, later = Program(graph, list(m), early), Program(graph, [*early, q], outputs)
    assert "sort" in prologue.count()
    assert later.count() == {"mul": 1, "add": 1}
    values = prologue([float(x) for x in X])
    assert later([*map(float, values), 2.0]) == pytest.approx([2.2, 1.3])
