"""Programs: evaluation on floats, and the division into early and late parts."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from udkjax.expressions import Graph, ScalarProgram, frontier, trace

X = np.array([0.3, -0.7, 1.1])


def test_floats_are_evaluated_without_compiling():
    graph = Graph()
    x, y = (graph.input(name, "state") for name in "xy")
    f = lambda x, y: jnp.sqrt(jnp.sin(x) ** 2 + jnp.exp(jnp.tanh(y))) / jnp.cos(x - y)  # noqa: E731
    (result,) = trace(f, 0.1, 0.2)(graph, np.asarray(x, object), np.asarray(y, object))
    program = ScalarProgram(graph, [x, y], [result.item()])
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


def test_numbers_of_python_give_what_jax_gives(emit):
    """Results that are not finite agree as well."""

    def f(x, y):
        several = [jnp.abs(x), jnp.arctan2(x, y), x**3, x**-2, jnp.maximum(x, y), jnp.minimum(x, y), jnp.square(y), -x]
        compared = [x == y, x != y, x < y, x <= y, x > y, x >= y]
        return jnp.stack([*several, *(jnp.where(c, x, y + 1.0) for c in compared)])

    samples = np.array(np.meshgrid(*[[-2.0, 0.0, 1.5, np.inf, np.nan]] * 2)).reshape(2, -1)
    program = emit(f, 0.1, 0.2)
    found = np.array([program.on_floats(x, y)[0] for x, y in samples.T])
    np.testing.assert_allclose(found, jax.jit(jax.vmap(f))(*samples), rtol=1e-15)


def test_an_operation_is_traced_once_for_each_value_it_has(emit):
    """A program counts the operations of its jaxpr."""
    program = emit(lambda x: (x[0] - x[1]) * jnp.sin(x[2]) + (x[1] - x[0]) / x[2], X).program
    (call,) = jax.make_jaxpr(lambda values: program(values))([jnp.asarray(x) for x in X]).jaxpr.eqns
    names = sorted(e.primitive.name for e in call.params["jaxpr"].jaxpr.eqns)
    assert names == sorted("sin" if name == "sincos" else name for name, n in program.count().items() for _ in range(n))


@pytest.fixture
def split():
    """A function of parameters m and l and the state q: sqrt(m) l (q + 1 / m) + l^2. Terms without q are early."""
    graph = Graph()
    m, length = (graph.input(name, "parameter") for name in ("m", "l"))
    q = graph.input("q", "state")
    output = graph.sqrt(m) * length * (q + 1.0 / m) + length * length
    early = frontier(graph, [output], lambda node: node.depends <= {"parameter"})
    return (
        ScalarProgram(graph, [m, length], early),
        ScalarProgram(graph, [*early, q], [output]),
        ScalarProgram(graph, [m, length, q], [output]),
    )


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
    assert ScalarProgram(graph, [*early, q], outputs)([3.0, 9.0, 2.0]) == [9.0, 6.0, 2.0]


def test_what_opaque_nodes_take_can_be_replaced():
    graph = Graph()
    m = np.array([graph.input(k, "parameter") for k in range(3)], object)
    q = graph.input("q", "state")
    (ordered,), bent = trace(jnp.sort, jnp.asarray(X))(graph, m), trace(jnp.tanh, 0.5)(graph, q * m[1])
    outputs = [ordered[2] * q, ordered[0] + bent[0].item()]
    inputs = {m[0].index: m[0], m[1].index: -q, m[2].index: m[2], q.index: q + 1.0}
    found = graph.copy(ScalarProgram(graph, [*m, q], outputs), inputs)
    values = [*map(float, X), 0.4]
    expected = ScalarProgram(graph, [*m, q], outputs)([values[0], -0.4, values[2], 1.4])
    assert ScalarProgram(graph, [*m, q], found)(values) == pytest.approx(expected)


def test_an_early_opaque_node_hands_over_its_results():
    graph = Graph()
    m = np.array([graph.input(k, "parameter") for k in range(3)], object)
    q = graph.input("q", "state")

    def exchange(x):  # once, but how often depends on a number
        return jax.lax.while_loop(lambda s: s[0] < 1.0, lambda s: (s[0] + 1.0, s[1][jnp.array([1, 0, 2])]), (x[0], x))[1]

    (ordered,) = trace(exchange, jnp.asarray(X))(graph, m)
    outputs = [ordered[2] * q, ordered[0] + q]
    early = frontier(graph, outputs, lambda node: node.depends <= {"parameter"})
    prologue, later = ScalarProgram(graph, list(m), early), ScalarProgram(graph, [*early, q], outputs)
    assert prologue.count() == {"while": 1}
    assert later.count() == {"mul": 1, "add": 1}
    values = prologue([float(x) for x in X])
    assert later([*map(float, values), 2.0]) == pytest.approx([2.2, 1.3])


@pytest.mark.parametrize(("x", "y"), [(1.0, 0.0), (0.0, 0.0), (3.0, 4.0)])
def test_a_branch_that_is_not_taken_may_divide_by_zero(x, y):
    """As in JAX: `hypot` divides by the larger of its arguments, and chooses afterwards."""
    graph = Graph()
    inputs = [graph.input(name, "state") for name in "xy"]
    f = lambda x, y: jnp.hypot(x, y) + jnp.where(y > 0, x / jnp.maximum(y, 0.0), 0.0)  # noqa: E731
    (result,) = trace(f, 0.1, 0.2)(graph, *(np.asarray(s, object) for s in inputs))
    assert ScalarProgram(graph, inputs, [result.item()])([x, y])[0] == pytest.approx(float(f(x, y)), rel=1e-15)


def test_a_program_on_floats_and_arrays_is_not_prepared_for_traces():
    """Scenes have hundreds of programs, and JAX keeps some kilobytes for each function under jit."""
    graph = Graph()
    x = graph.input("x", "state")
    program = ScalarProgram(graph, [x], [x * x + 1.0])
    assert program([2.0]) == [5.0] and program.by_numpy([np.array([2.0, 3.0])])[0].tolist() == [5.0, 10.0]
    assert "_traced" not in vars(program)
    assert float(jax.jit(lambda x: program([x])[0])(2.0)) == 5.0 and "_traced" in vars(program)
