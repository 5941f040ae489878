"""Parameters of a mechanism one number at a time, and the program that computes the numbers of its equations from them."""

from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.equations.terms.structure import numbers_as_vector
from udkjax.expressions import Graph, Scalar, ScalarProgram, trace
from udkjax.native.language.ir import Function
from udkjax.native.language.program import vector_function
from udkjax.native.packing import SampleRows
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.number_fields import split_index


def scalar_parameters(mechanism: Mechanism, names: Sequence[str] | None = None) -> dict[str, float]:
    """Return parameters as single numbers by name, such as `joint.A.points[0][1]` for an entry of an array.

    Args:
        mechanism: the scene.
        names: names of parameters or of entries; by default all parameters of the scene, except numbers that are computed from
            its drawing: as parameters they would not follow changes of the drawing.

    Returns:
        The values by name, in order.

    Raises:
        SceneError: a name is unknown.
    """
    known, scalars = mechanism.parameters(), {}
    for name in mechanism.independent_parameters() if names is None else names:
        owner, index = split_index(name, known)
        if owner not in known or (index and index not in np.ndindex(*np.shape(known[owner])[: len(index)])):
            mechanism.with_parameters({name: 0.0})  # raises an error that names the parameter
        value = np.asarray(known[owner])
        for inner in np.ndindex(*value.shape[len(index) :]):
            scalars[owner + "".join(f"[{k}]" for k in (*index, *inner))] = float(value[(*index, *inner)])
    return scalars


class NumberProgram:
    """The numbers of a mechanism's equations, then its breakpoints and further numbers, as a function of some parameters.

    Attributes:
        base: the present values of all numbers.
        changing_numbers: indices of the numbers that depend on the parameters.
        count: number of the numbers before the breakpoints.
        knots: number of breakpoints.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        values: Mapping[str, float],
        dress: Callable[[Mechanism], Mechanism],
        further: Callable[[Mechanism], Sequence[Array | np.ndarray]] = lambda mechanism: (),
    ):
        """Trace the program.

        Args:
            mechanism: the scene.
            values: the parameters with their present values.
            dress: returns the mechanism to simulate, from the mechanism with changed parameters.
            further: additional numbers, as a function of the mechanism with changed parameters.
        """

        def parts(given: Mechanism) -> list[Array | np.ndarray]:
            return [*_numbers(dress(given)), numbers_as_vector(further(given))]

        def numbers(p: Array) -> Array:
            given = mechanism.with_parameters({name: p[k] for k, name in enumerate(values)})
            return jnp.concatenate([jnp.asarray(x, float) for x in parts(given)])

        known = parts(mechanism)
        self.base = np.concatenate(known)
        self.count, self.knots = (len(x) for x in known[:2])
        self._numbers, self._parameter_count = numbers, len(values)
        self._program, self.changing_numbers = traced_program(numbers, len(values))

    def function(self) -> Function:
        """Return the machine code of `numbers(parameters, numbers)`, which writes the numbers that depend on the parameters."""
        return vector_function(self._program, "numbers", "parameters", "numbers", self.changing_numbers)

    def function_along(self) -> Function:
        """Return the machine code of `numbers_along(parameters, numbers)`, which writes the changes of these numbers.

        Its input `parameters` has the parameters, followed by their changes.
        """

        def along(x: Array) -> Array:
            return jax.jvp(self._numbers, (x[: self._parameter_count],), (x[self._parameter_count :],))[1]

        program, changing_outputs = traced_program(along, 2 * self._parameter_count)
        return vector_function(program, "numbers_along", "parameters", "numbers", changing_outputs)

    def __call__(self, values: Sequence[float]) -> Float[np.ndarray, "numbers"]:
        """Return all numbers for these values of the parameters, by NumPy."""
        numbers = self.base.copy()
        numbers[self.changing_numbers] = [float(x) for x in self._program([float(x) for x in values])]
        return numbers


def traced_program(function: Callable[[Array], Array], count: int) -> tuple[ScalarProgram, list[int]]:
    """Return a program of those outputs of a function that depend on its `count` inputs, and the indices of these outputs."""
    graph = Graph(np.float64)
    inputs, outputs = [graph.input(k, "parameter") for k in range(count)], list[Scalar]()
    if count:
        (found,) = trace(function, jax.ShapeDtypeStruct((count,), jnp.result_type(float)))(graph, np.array(inputs, object))
        outputs = list(found)
    changing_outputs = [k for k, s in enumerate(outputs) if s.constant is None]
    return ScalarProgram(graph, inputs, [outputs[k] for k in changing_outputs]), changing_outputs


def places_of_numbers(mechanism: Mechanism) -> Mechanism:
    """Return the mechanism with each number replaced by its place in the vector of all numbers."""
    leaves, tree = jax.tree.flatten(mechanism.without_origin.without_samples)
    starts = np.cumsum([0, *(np.size(x) for x in leaves)])
    numbered = [np.arange(k, k + np.size(x)).reshape(np.shape(x)) for k, x in zip(starts, leaves, strict=False)]
    return jax.tree.unflatten(tree, numbered)


def guess_of(mechanism: Mechanism) -> dict[str, np.ndarray]:
    """Return the initial guesses "q" and "v" of all bodies as flat arrays; with `places_of_numbers`, the places of these."""
    bodies = mechanism.bodies.values()
    return {
        "q": np.concatenate([[*np.ravel(body.position), body.angle] for body in bodies]),
        "v": np.concatenate([[*np.ravel(body.velocity), body.angular_velocity] for body in bodies]),
    }


def _numbers(mechanism: Mechanism) -> list[Array | np.ndarray]:
    """Return the vector of all numbers of a mechanism, with a row of zeros instead of samples, and the breakpoints."""
    breakpoints = mechanism.breakpoints
    stand_in = SampleRows(mechanism, breakpoints).stand_in(mechanism)
    return [numbers_as_vector(stand_in.numbers), np.zeros(0) if breakpoints is None else breakpoints]
