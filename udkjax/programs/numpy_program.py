"""Evaluate JAX programs by NumPy, operation by operation, without the seconds that XLA takes to compile them.

Loops and branches run in Python. An operation without a NumPy rule is expanded into others if possible; otherwise JAX compiles it
alone.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

import jax
import numpy as np
from jax.extend.core import Jaxpr, Literal, Primitive, jaxprs_in_params

from udkjax.programs.numpy_rules import PRESERVED_DTYPES, RULES
from udkjax.programs.plain_steps import plain_step

Step = tuple[Callable[..., Any], list[int], Any]  # a function, and the places of its arguments and of its result or results
ENTRIES_PER_OPERATION = 2_000  # number of array entries that take as long as the overhead of an operation

_EXPANSIONS: dict[Primitive, Callable[..., Callable[..., Any]]] = {}
_EVALUATIONS: dict[Primitive, Callable[..., Any]] = {}


def expand_as(primitive: Primitive, function: Callable[..., Callable[..., Any]]) -> None:
    """Register the expansion of a primitive into other operations.

    Args:
        primitive: the primitive.
        function: a function of the primitive's parameters that returns a function of its arrays, which JAX can trace.
    """
    _EXPANSIONS[primitive] = function


def expansion_of(primitive: Primitive, parameters: Mapping[str, Any]) -> Callable[..., Any] | None:
    """Return the function of arrays whose operations replace a primitive, from `expand_as` or from JAX; None if there is none."""
    if primitive in _EXPANSIONS:
        return _EXPANSIONS[primitive](**parameters)
    if "_prim" not in parameters:
        return None
    defined = parameters["_prim"]
    return lambda *xs: defined.expand(*jax.tree.unflatten(defined.in_tree, xs))


def evaluate_as(primitive: Primitive, function: Callable[..., Any]) -> None:
    """Register a function of NumPy arrays, and of the parameters by keyword, that evaluates a primitive."""
    _EVALUATIONS[primitive] = function


class TooLongError(Exception):
    """An exception for an evaluation that exceeds its limit of operations (`Meter`)."""


class Meter:
    """A count of operations, which ends an evaluation that exceeds `limit` by a `TooLongError`.

    An operation on a large array counts as several.
    """

    def __init__(self, limit: float):
        self.count, self.limit = 0, limit

    def add(self, operations: int) -> None:
        self.count += operations
        if self.count > self.limit:
            raise TooLongError


class NumpyProgram:
    """A JAX program as a list of NumPy steps.

    Programs that the JAX program calls are inlined. Operations that do not depend on its inputs are evaluated only once, when the
    list is made, unless their results are large or their rule needs more than arrays.
    """

    def __init__(self, jaxpr: Jaxpr, constants: Sequence[Any]):
        self._memory: list[Any] = [None]  # the meter, then constants, inputs and results
        self._constants: dict[Any, int] = {}  # the places of constants by their content
        self._fixed: set[int] = set()
        self._steps: list[Step] = []
        self._cost = 0
        self._known: dict[Any, list[int]] = {}  # the places of the results, by operation
        self._inputs = [self._new() for _ in jaxpr.invars]
        self._outputs = self._add(jaxpr, constants, self._inputs)
        del self._known, self._constants, self._fixed

    def _add(self, jaxpr: Jaxpr, constants: Sequence[Any], inputs: Sequence[int]) -> list[int]:
        """Add the steps of a program, and return the places of its results."""
        places: dict[Any, int] = dict(zip(jaxpr.invars, inputs, strict=True))
        places.update((v, self._place_of_value(np.asarray(x))) for v, x in zip(jaxpr.constvars, constants, strict=True))

        def place(v: Any) -> int:
            return self._place_of_value(np.asarray(v.val, _type(v).dtype)[()]) if isinstance(v, Literal) else places[v]

        for equation in _needed(jaxpr):
            given = [place(v) for v in equation.invars]
            places.update(zip(equation.outvars, self._results_of(equation, given), strict=True))
        return [place(v) for v in jaxpr.outvars]

    def _results_of(self, equation: Any, given: list[int]) -> list[int]:
        """Add the steps of one operation, and return the places of its results."""
        if (called := _called_program(equation)) is not None:
            return self._add(*called, given)
        if equation.primitive.name in _IDENTITIES:
            return given
        key = _operation(equation, given)
        if key in self._known:  # functions that are called one after another compute the same: JAX traces each of them anew
            return self._known[key]
        function = plain_step(equation.primitive.name, equation.params, [_type(v) for v in (*equation.invars, *equation.outvars)])
        if function is not None and self._fixed.issuperset(given) and _type(equation.outvars[0]).size <= ENTRIES_PER_OPERATION:
            with np.errstate(all="ignore"):
                results = [self._place_of_value(np.asarray(function(*[self._memory[k] for k in given])))]
        else:
            results = [self._new() for _ in equation.outvars]
            if function is None:
                function, given = _step_of(equation), [0, *given]
            self._cost += 1 + sum(_type(v).size for v in equation.outvars) // ENTRIES_PER_OPERATION
            self._steps.append((function, given, results if equation.primitive.multiple_results else results[0]))
        if key is not None:
            self._known[key] = results
        return results

    def _new(self) -> int:
        self._memory.append(None)
        return len(self._memory) - 1

    def _place_of_value(self, value: Any) -> int:
        """Return the place in the memory of a constant; constants of equal content share one."""
        key = value.dtype, value.shape, value.tobytes()
        if key not in self._constants:
            self._constants[key] = place = self._new()
            self._memory[place] = value
            self._fixed.add(place)
        return self._constants[key]

    def __call__(self, meter: Meter, inputs: Sequence[Any]) -> list[Any]:
        """Return the results for inputs that are NumPy arrays; the meter counts the operations."""
        meter.add(self._cost)
        memory = self._memory.copy()
        memory[0] = meter
        for place, x in zip(self._inputs, inputs, strict=True):
            memory[place] = x
        for function, places, results in self._steps:
            values = function(*[memory[k] for k in places])
            if type(results) is int:
                memory[results] = values
            else:
                for k, x in zip(results, values, strict=True):
                    memory[k] = x
        return [memory[k] for k in self._outputs]


def _called_program(equation: Any) -> tuple[Jaxpr, Sequence[Any]] | None:
    """Return the program that an operation calls, with its constants; None if the operation is not merely such a call."""
    primitive = equation.primitive
    if primitive in _EVALUATIONS or primitive.name not in _CALLS:
        return None
    called = equation.params[_CALLS[primitive.name]]
    return (called.jaxpr, called.consts) if hasattr(called, "consts") else (called, ())


def _needed(jaxpr: Jaxpr) -> list[Any]:
    """Return the operations of a program that have effects or that its results depend on, in order."""
    used, needed = set[Any](v for v in jaxpr.outvars if not isinstance(v, Literal)), list[Any]()
    for equation in reversed(jaxpr.eqns):
        if equation.effects or not used.isdisjoint(equation.outvars):
            used.update(v for v in equation.invars if not isinstance(v, Literal))
            needed.append(equation)
    return needed[::-1]


def _operation(equation: Any, inputs: Sequence[int]) -> Any:
    """Return a key that only operations with the same results share; None if their parameters cannot be compared."""
    if equation.effects:
        return None
    key = equation.primitive, tuple(inputs), tuple(equation.params.items())
    try:
        hash(key)
    except TypeError:
        return None
    return key


def _type(v: Any) -> Any:
    return v.aval


def count_operations(jaxpr: Any) -> int:
    """Return the number of operations of a program; bodies of loops are counted once, and all branches are counted."""
    inner = (x for e in jaxpr.eqns for x in jaxprs_in_params(e.params))
    return len(jaxpr.eqns) + sum(map(count_operations, inner))


def has_rules(jaxpr: Any) -> bool:
    """Return True if NumPy has rules for all operations of a program, so that JAX is never called."""

    def has_rule(equation: Any) -> bool:
        primitive = equation.primitive
        if primitive in _EVALUATIONS or primitive.name in _CALLS or primitive.name in _CONTROL_RULES or primitive.name in RULES:
            return all(map(has_rules, jaxprs_in_params(equation.params)))
        expanded = _Expanded(equation).trace()
        return expanded is not None and has_rules(expanded)

    return all(map(has_rule, jaxpr.eqns))


_PROGRAMS: "WeakKeyDictionary[Any, NumpyProgram]" = WeakKeyDictionary()


def numpy_program(jaxpr: Any) -> NumpyProgram:
    """Return the NumPy program of a jaxpr, which is closed or has no constants; cached by jaxpr."""
    program = _PROGRAMS.get(jaxpr)
    if program is None:
        arguments = (jaxpr.jaxpr, jaxpr.consts) if hasattr(jaxpr, "consts") else (jaxpr, ())
        program = _PROGRAMS[jaxpr] = NumpyProgram(*arguments)
    return program


# --- steps


def _step_of(equation: Any) -> Callable[..., Any]:
    """Return an operation as a function of the meter and of the operation's NumPy arrays."""
    primitive, parameters = equation.primitive, equation.params
    if primitive in _EVALUATIONS:
        return lambda _, *xs: _EVALUATIONS[primitive](*xs, **parameters)
    if primitive.name in _CONTROL_RULES:
        return _CONTROL_RULES[primitive.name](**parameters)
    rule = RULES.get(primitive.name)
    if rule is not None and not (primitive.name in ("reduce_or", "reduce_and") and equation.invars[0].aval.dtype != bool):
        return _by_rule(equation, rule)
    return _Expanded(equation)


def _by_rule(equation: Any, rule: Callable[..., Any]) -> Callable[..., Any]:
    primitive, parameters = equation.primitive, equation.params
    dtypes = [v.aval.dtype for v in equation.outvars]
    exact = all(dtype in PRESERVED_DTYPES for dtype in dtypes)

    def step(_: Meter, *xs: Any) -> Any:
        try:
            result = rule(*xs, **parameters)
        except np.linalg.LinAlgError:  # a singular matrix: XLA returns infinity
            result = NotImplemented
        if result is NotImplemented:
            return _by_jax(primitive, parameters, xs)
        if exact:
            return result
        if primitive.multiple_results:
            return [np.asarray(x, dtype) for x, dtype in zip(result, dtypes, strict=True)]
        return np.asarray(result, dtypes[0])

    return step


def _by_jax(primitive: Primitive, parameters: dict[str, Any], xs: Sequence[Any]) -> Any:
    result = primitive.bind(*(jax.device_put(np.asarray(x)) for x in xs), **parameters)
    return [np.asarray(x) for x in result] if primitive.multiple_results else np.asarray(result)


class _Expanded:
    """A step that evaluates the operations into which an operation is expanded (`expansion_of`).

    They are traced at the first evaluation. If there is no expansion, JAX evaluates the operation.
    """

    def __init__(self, equation: Any):
        self._primitive, self._parameters = equation.primitive, equation.params
        self._inputs = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in equation.invars]
        self._program: Any = None

    def __call__(self, meter: Meter, *xs: Any) -> Any:
        if self._program is None:
            traced = self.trace()
            self._program = False if traced is None else numpy_program(traced)
        if self._program is False:
            return _by_jax(self._primitive, self._parameters, xs)
        results = self._program(meter, xs)
        return results if self._primitive.multiple_results else results[0]

    def trace(self) -> Any:
        """Return the program of the operations into which this one is expanded; None if JAX has to evaluate it."""
        function = self._function()
        return None if function is None else jax.make_jaxpr(function)(*self._inputs)

    def _function(self) -> Callable[..., Any] | None:
        primitive, parameters = self._primitive, self._parameters
        if (expansion := expansion_of(primitive, parameters)) is not None:
            return expansion
        impl = primitive.impl
        if isinstance(impl, partial) or impl.__module__.startswith(("jax.", "jaxlib")):
            return None
        return lambda *xs: impl(*xs, **parameters)


def _while(cond_jaxpr: Any, body_jaxpr: Any, cond_nconsts: int, body_nconsts: int, **_: Any) -> Callable[..., Any]:
    condition, body = numpy_program(cond_jaxpr), numpy_program(body_jaxpr)

    def step(meter: Meter, *xs: Any) -> list[Any]:
        of_condition, of_body = xs[:cond_nconsts], xs[cond_nconsts : cond_nconsts + body_nconsts]
        state = list(xs[cond_nconsts + body_nconsts :])
        while np.any(goes_on := condition(meter, [*of_condition, *state])[0]):
            results = body(meter, [*of_body, *state])
            state = (
                list(results) if np.ndim(goes_on) == 0 else [_where(goes_on, x, y) for x, y in zip(results, state, strict=True)]
            )
        return state

    return step


def _where(condition: np.ndarray, a: Any, b: Any) -> np.ndarray:
    """Return a where the condition holds, otherwise b; conditions have the leading axes of a, as in loops of a batch."""
    return np.where(condition.reshape(condition.shape + (1,) * (np.ndim(a) - condition.ndim)), a, b)


def _cond(branches: Sequence[Any], **_: Any) -> Callable[..., Any]:
    programs = [numpy_program(branch) for branch in branches]

    def step(meter: Meter, index: Any, *xs: Any) -> list[Any]:
        return programs[min(max(int(index), 0), len(programs) - 1)](meter, xs)

    return step


def _scan(jaxpr: Any, length: int, reverse: bool, **parameters: Any) -> Callable[..., Any]:
    program = numpy_program(jaxpr)
    if "ft_in" in parameters:
        constants, carry, _ = (len(group) for group in parameters["ft_in"].unpack())
    else:
        constants, carry = parameters["num_consts"], parameters["num_carry"]
    avals = jaxpr.out_avals[carry:]

    def step(meter: Meter, *xs: Any) -> list[Any]:
        fixed, state, rows = xs[:constants], list(xs[constants : constants + carry]), xs[constants + carry :]
        outputs = [np.zeros((length, *a.shape), a.dtype) for a in avals]
        for k in range(length - 1, -1, -1) if reverse else range(length):
            results = program(meter, [*fixed, *state, *(x[k] for x in rows)])
            state = results[:carry]
            for output, y in zip(outputs, results[carry:], strict=True):
                output[k] = y
        return [*state, *outputs]

    return step


def _linear_solve(const_lengths: Any, jaxprs: Any, **_: Any) -> Callable[..., Any]:
    program, start = numpy_program(jaxprs.solve), const_lengths.matvec + const_lengths.vecmat
    end = start + const_lengths.solve
    right_sides = end + const_lengths.transpose_solve

    return lambda meter, *xs: program(meter, [*xs[start:end], *xs[right_sides:]])


# Operations that only call a program, and the parameter that has it.
_CALLS = {
    "jit": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "eval_jaxpr": "call_jaxpr",
    "deferred_program": "call_jaxpr",
    "custom_vmap_call": "call",
    "remat2": "jaxpr",
}
_IDENTITIES = ("stop_gradient", "copy", "copy_p")
_CONTROL_RULES: dict[str, Callable[..., Callable[..., Any]]] = {
    "while": _while,
    "cond": _cond,
    "scan": _scan,
    "custom_linear_solve": _linear_solve,
}
