"""The programs of a scene on arrays, without machine code: by NumPy, without compilation, or by JAX."""

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, Generic, NamedTuple

import numpy as np

from udkjax.annotations import AnyArray, Time
from udkjax.arrays import ArrayLibrary
from udkjax.equations.programs.scene_programs import ScenePrograms, scene_programs
from udkjax.equations.terms.rest_program import CURVATURE, OF_LOADS, REDUCED
from udkjax.equations.terms.structure import concrete_numbers
from udkjax.expressions.loops.array_loops import ArrayLoops
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.mechanism import Mechanism

ACCELERATION_OUTPUTS = "a", "multipliers", "distance", "psi_q"
LINEARIZATION_OUTPUTS = "dq1", "dv", "dv1", "multipliers", "distance", REDUCED


class Accelerations(NamedTuple):
    """Accelerations (n, T), multipliers (m, T), distances from dependent rows (T,) and entries of Psi_q (entries, T)."""

    a: np.ndarray
    multipliers: np.ndarray
    distance: np.ndarray
    entries: np.ndarray


class SceneArrays(Generic[AnyArray]):
    """Psi, Psi_dot, Psi_q and loads of a mechanism, by NumPy or JAX.

    Arguments are t (), q and v (n,) of one state or, for NumPy, t (T,), q and v (n, T) of many; results are then (..., T).

    Args:
        programs: The programs of the mechanism's scene.
        numbers: All numbers of the scene and the gains.
        xp: NumPy or jax.numpy.
    """

    def __init__(self, programs: ScenePrograms, numbers: AnyArray, xp: ArrayLibrary):
        self.programs, self.numbers, self._xp = programs, numbers, xp
        self._constants = constants_of(programs, numbers, xp)
        self._evaluators = dict[tuple[str, ...], _Evaluator]()

    def _evaluator(self, outputs: tuple[str, ...]) -> "_Evaluator":
        if outputs not in self._evaluators:
            self._evaluators[outputs] = _evaluator(self.programs, self._xp, *outputs)
        return self._evaluators[outputs]

    @cached_property
    def _constant_list(self) -> list[float]:
        return self._constants.tolist()

    @cached_property
    def _constants_address(self) -> int:
        return np.asarray(self._constants).__array_interface__["data"][0]

    def psi(self, t: Time, q: AnyArray) -> AnyArray:
        """Return Psi (m,)."""
        return self._run(("psi",), t, q, q)["psi"]

    def geometry(self, t: Time, q: AnyArray, v: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Return Psi (m,), Psi_dot (m,), and the entries of Psi_q in the order of `ScenePrograms.psi_q_entries`."""
        arrays = self._run(("psi_q", "psi", "psi_dot"), t, q, v)
        return arrays["psi"], arrays["psi_dot"], self._entries(arrays)

    def jacobian(self, t: Time, q: AnyArray) -> AnyArray:
        """Return the entries of Psi_q in the order of `ScenePrograms.psi_q_entries`."""
        return self._entries(self._run(("psi_q",), t, q, q))

    def _entries(self, arrays: Mapping[str, AnyArray]) -> AnyArray:
        _, _, places, factors = self.programs.psi_q_entries
        return (arrays["psi_q"][places].T * factors).T

    def loads(self, t: Time, q: AnyArray, v: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Return a_F (n,), and b (m,)."""
        terms = self._run(("terms",), t, q, v)["terms"]
        return terms[: self.programs.coordinate_count], terms[self.programs.coordinate_count :]

    def energy(self, t: Time, q: AnyArray, v: AnyArray) -> AnyArray:
        """Return the kinetic and the potential energy (2,)."""
        return self._run(("energy",), t, q, v)["energy"]

    def element_loads(self, t: Time, q: AnyArray, v: AnyArray) -> dict[str, AnyArray]:
        """Return the arrays `OF_LOADS`: entries of the loads of force elements and their derivatives, as `RestProgram.places`."""
        return self._run(OF_LOADS, t, q, v)

    def curvature(self, t: Time, q: AnyArray, multipliers: AnyArray) -> AnyArray:
        """Return the entries of (lambda^T Psi)_qq, as `RestProgram.places` orders them."""
        found = self._run((CURVATURE,), t, q, q, multipliers=multipliers)
        return found[CURVATURE] if CURVATURE in found else self._xp.zeros(0)

    def linearization(self, t: Time, q: AnyArray, direction: AnyArray) -> dict[str, AnyArray] | None:
        """Return the linearization at rest along the tangent part of `direction`, by elimination.

        The result has the arrays `LINEARIZATION_OUTPUTS` by name, which `RestProgram.reduction` and the output "balance" explain.
        It is None if neither machine code nor Python's floats can run the program.
        """
        return self._run_at_state(LINEARIZATION_OUTPUTS, t, q, self._xp.zeros_like(q), {"dq": direction}, often=True)

    def accelerations(self, t: Time, q: AnyArray, v: AnyArray) -> "Accelerations | None":
        """Return accelerations at many states by elimination in machine code; None until compiling the program pays off."""
        found: Any = self._run_at_many(
            self._evaluator(ACCELERATION_OUTPUTS), {"t": np.asarray(t, float).reshape(1, -1), "q": q, "v": v}
        )
        entries: Any = found and self._entries(found)
        return found and Accelerations(found["a"], found["multipliers"], found["distance"][0], entries)

    def newton_step(self, t: Time, q: AnyArray) -> tuple[AnyArray, AnyArray, float] | None:
        """Return q (n,) after a Newton step to Psi = 0 by elimination, Psi (m,) at q, and the distance from dependent rows.

        The step is the smallest in the metric of M. None if neither machine code nor Python's floats can run the program.
        """
        found = self._run_at_state(("q1", "distance", "psi"), t, q, q, {}, often=True)
        return None if found is None else (found["q1"], found["psi"], float(found["distance"][0]))

    def _run(self, outputs: tuple[str, ...], t: Time, q: AnyArray, v: AnyArray, **given: AnyArray) -> dict[str, AnyArray]:
        """Return the arrays of some outputs at one state, or at many if q is (n, T).

        The iterations of the program's loops must not depend on each other; `given` are further arrays that it reads.
        """
        xp = self._xp
        many = q.shape[1:]
        if not many and xp is np and (found := self._run_at_state(outputs, t, q, v, given)) is not None:
            return found
        evaluate, sizes, _ = evaluator = self._evaluator(outputs)
        if many and xp is np:
            state = {"t": np.asarray(t, float).reshape(1, -1), "q": q, "v": v, **given}
            if (found := self._run_at_many(evaluator, state)) is not None:
                return found
        blank = {x: xp.zeros((size, *many)) for x, size in sizes.items()}
        constants = self._constants[:, None] if many else self._constants
        state = {"constants": constants, "t": xp.reshape(xp.asarray(t, float), (1, *many)), "q": q, "v": v}
        return evaluate(blank | state | given)

    def _run_at_many(self, evaluator: "_Evaluator", state: Mapping[str, Any]) -> dict[str, AnyArray] | None:
        """Return the results of a program at many states by machine code; None until that pays off, or if it is impossible."""
        compiled: Any = evaluator.loops.at_many(evaluator.blank, {name: len(x) for name, x in state.items()})
        return None if compiled is None else compiled(np.asarray(self._constants), state)

    def _run_at_state(
        self, outputs: tuple[str, ...], t: Any, q: AnyArray, v: AnyArray, given: Mapping[str, AnyArray], often: bool = False
    ) -> dict[str, AnyArray] | None:
        """Return the results of a program at one state: by machine code if compiling pays off, else on Python's floats.

        None if neither is possible. `often`: the program will run so often that compiling pays off at once.
        """
        evaluate, sizes, results = self._evaluator(outputs)
        state = {"t": t, "q": q, "v": v, **given}
        if evaluate.compiled is None and evaluate.is_worth_compiling(often):
            evaluate.compile(sizes | {name: np.size(x) for name, x in state.items()})
        if evaluate.compiled is not None:
            return evaluate.compiled(self._constants_address, state)
        lists: dict[str, Any] = {x: [0.0] * size for x, size in sizes.items()}
        lists |= {"constants": self._constant_list, "t": [float(t)]}
        lists |= {x: value.tolist() for x, value in state.items() if x != "t"}
        return {x: self._xp.array(lists[x]) for x in results} if evaluate.on_lists(lists) else None


def arrays_in_time(mechanism: Mechanism) -> Callable[[Time], SceneArrays[np.ndarray]]:
    """Return the arrays of a mechanism with concrete numbers as a function of time (s), on which sampled numbers depend."""
    if mechanism.samples:
        return lambda t: _arrays_at(mechanism, t)
    fixed = _fixed_arrays(mechanism)
    return lambda t: fixed


@cached_by_identity
def _fixed_arrays(mechanism: Mechanism) -> SceneArrays[np.ndarray]:
    return _arrays_at(mechanism, 0.0)


def _arrays_at(mechanism: Mechanism, t: Time) -> SceneArrays[np.ndarray]:
    return SceneArrays(scene_programs(mechanism), concrete_numbers(mechanism, t), np)


def constants_of(programs: ScenePrograms, numbers: AnyArray, xp: ArrayLibrary) -> AnyArray:
    """Return the array `constants` of the programs' loops from the numbers of a scene and the gains, for thresholds of zero."""
    arrays = {"numbers": xp.concatenate([numbers, xp.zeros(2)]), "constants": xp.zeros(len(programs.constants))}
    return _prologue(programs, xp)(arrays)["constants"]


@cached_by_identity
def _prologue(programs: ScenePrograms, xp: ArrayLibrary) -> ArrayLoops:
    return ArrayLoops(programs.prologue, xp)


class _Evaluator(NamedTuple):
    """A program as a function of its arrays, with the names and lengths of arrays that a call needs."""

    loops: ArrayLoops
    blank: dict[str, int]  # the lengths of the arrays that it begins with zeros
    results: tuple[str, ...]  # the arrays that it writes for its callers


@cached_by_identity
def _evaluator(programs: ScenePrograms, xp: ArrayLibrary, *outputs: str) -> _Evaluator:
    """Return the program of some outputs as an `_Evaluator`."""
    p, n, m = programs, programs.coordinate_count, programs.row_count
    at_rest = p.at_rest.sizes if outputs[0] in (*OF_LOADS, CURVATURE) or outputs == LINEARIZATION_OUTPUTS else {}
    program = p.linearization if outputs == LINEARIZATION_OUTPUTS else p.at_rest.of(*outputs) if at_rest else p.of(*outputs)
    sizes = p.scratch | {"psi": m, "psi_dot": m, "multipliers": m, "terms": p.term_count, "energy": 2} | at_rest
    sizes |= dict.fromkeys(("a", "q1", "dq1", "dv", "dv1"), n) | {"distance": 1, REDUCED: 3}
    results = tuple(x for x in outputs if not at_rest or x in program.written)
    given = {"multipliers"} if outputs == (CURVATURE,) else set()
    blank = {x: size for x, size in sizes.items() if x in (program.arrays | set(results)) - given}
    return _Evaluator(ArrayLoops(program, xp, results or None), blank, results)
