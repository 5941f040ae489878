"""The programs of a scene on arrays, without machine code: by NumPy, without compilation, or by JAX."""

from collections.abc import Callable
from functools import lru_cache
from typing import Generic

import numpy as np

from udkjax.annotations import AnyArray, Time
from udkjax.arrays import ArrayLibrary
from udkjax.equations.scene_programs import ScenePrograms, scene_programs
from udkjax.equations.structure import numbers_as_vector
from udkjax.expressions.loop_program import ArrayLoops
from udkjax.scene.mechanism import Mechanism

ROWS_AND_LOADS = ("psi", "psi_dot", "psi_q", "terms")


class SceneArrays(Generic[AnyArray]):
    """Psi, Psi_dot, Psi_q and loads of a mechanism.

    Args:
        programs: The programs of the mechanism's scene.
        numbers: All numbers of the scene and the gains.
        xp: NumPy or jax.numpy.
    """

    def __init__(self, programs: ScenePrograms, numbers: AnyArray, xp: ArrayLibrary):
        self.programs, self._xp = programs, xp
        self._constants = constants_of(programs, numbers, xp)

    def psi(self, t: Time, q: AnyArray) -> AnyArray:
        """Return Psi (m,)."""
        return self._run("psi", t, q, q)["psi"]

    def geometry(self, t: Time, q: AnyArray, v: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Return Psi (m,), Psi_dot (m,), and the entries of Psi_q in the order of `ScenePrograms.psi_q_entries`."""
        arrays = self._run("geometry", t, q, v)
        _, _, places, factors = self.programs.psi_q_entries
        return arrays["psi"], arrays["psi_dot"], arrays["psi_q"][places] * factors

    def loads(self, t: Time, q: AnyArray, v: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Return a_F (n,), and b (m,)."""
        terms = self._run("equation_terms", t, q, v)["terms"]
        return terms[: self.programs.coordinate_count], terms[self.programs.coordinate_count :]

    def _run(self, name: str, t: Time, q: AnyArray, v: AnyArray) -> dict[str, AnyArray]:
        """Run a program whose loops have independent iterations."""
        p, xp = self.programs, self._xp
        evaluate, arrays = _evaluator(p, name, xp)
        sizes = p.scratch | {"psi": p.row_count, "psi_dot": p.row_count, "terms": p.term_count}
        blank = {x: xp.zeros(size) for x, size in sizes.items() if x in arrays}
        return evaluate(blank | {"constants": self._constants, "t": xp.reshape(xp.asarray(t, float), (1,)), "q": q, "v": v})


def arrays_in_time(mechanism: Mechanism) -> Callable[[Time], SceneArrays[np.ndarray]]:
    """Return the arrays of a mechanism with concrete numbers as a function of time (s), on which sampled numbers depend."""
    programs, is_sampled = scene_programs(mechanism), bool(mechanism.samples)

    def at(t: Time) -> SceneArrays[np.ndarray]:
        return SceneArrays(programs, np.asarray(numbers_as_vector(mechanism.at(t).numbers)), np)

    at_start = at(0.0)
    return at if is_sampled else lambda t: at_start


def constants_of(programs: ScenePrograms, numbers: AnyArray, xp: ArrayLibrary) -> AnyArray:
    """Return the constants of the loops from the numbers of a scene and the gains."""
    evaluate, _ = _evaluator(programs, "prologue", xp)
    arrays = {"numbers": xp.concatenate([numbers, xp.zeros(2)]), "constants": xp.zeros(len(programs.constants))}
    return evaluate(arrays)["constants"]


@lru_cache(maxsize=256)
def _evaluator(programs: ScenePrograms, name: str, xp: ArrayLibrary) -> tuple[ArrayLoops, set[str]]:
    """Return a program as a function of its arrays, and the names of these arrays."""
    program = getattr(programs, name)
    return ArrayLoops(program, xp), program.arrays | set(ROWS_AND_LOADS)
