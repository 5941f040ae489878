"""The programs of a scene on arrays, without machine code: by NumPy, without compilation, or by JAX."""

from collections.abc import Callable
from operator import attrgetter
from typing import Generic

import numpy as np

from udkjax.annotations import AnyArray, Time
from udkjax.arrays import ArrayLibrary
from udkjax.equations.rest_program import CURVATURE
from udkjax.equations.scene_programs import ScenePrograms, scene_programs
from udkjax.equations.structure import numbers_as_vector
from udkjax.expressions.array_loops import ArrayLoops
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.mechanism import Mechanism

ROWS_AND_LOADS = ("psi", "psi_dot", "psi_q", "terms", "energy")


class SceneArrays(Generic[AnyArray]):
    """Psi, Psi_dot, Psi_q and loads of a mechanism at a state, or by NumPy at many: t (T,), q and v (n, T), results (..., T).

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
        entries = (arrays["psi_q"][places].T * factors).T
        return arrays["psi"], arrays["psi_dot"], entries

    def loads(self, t: Time, q: AnyArray, v: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Return a_F (n,), and b (m,)."""
        terms = self._run("equation_terms", t, q, v)["terms"]
        return terms[: self.programs.coordinate_count], terms[self.programs.coordinate_count :]

    def energy(self, t: Time, q: AnyArray, v: AnyArray) -> AnyArray:
        """Return the kinetic and the potential energy (2,)."""
        return self._run("energy", t, q, v)["energy"]

    def element_loads(self, t: Time, q: AnyArray, v: AnyArray) -> dict[str, AnyArray]:
        """Return the entries of the loads of force elements and of their derivatives, as `RestProgram.places` orders them."""
        return self._run("at_rest.loads", t, q, v)

    def curvature(self, t: Time, q: AnyArray, multipliers: AnyArray) -> AnyArray:
        """Return the entries of (lambda^T Psi)_qq, as `RestProgram.places` orders them."""
        found = self._run("at_rest.curvature", t, q, q, multipliers=multipliers)
        return found[CURVATURE] if CURVATURE in found else self._xp.zeros(0)

    def _run(self, name: str, t: Time, q: AnyArray, v: AnyArray, **given: AnyArray) -> dict[str, AnyArray]:
        """Run a program whose loops have independent iterations."""
        p, xp = self.programs, self._xp
        evaluate, sizes = _evaluator(p, name, xp)
        many = q.shape[1:]
        blank = {x: xp.zeros((size, *many)) for x, size in sizes.items()}
        constants = self._constants[:, None] if many else self._constants
        state = {"constants": constants, "t": xp.reshape(xp.asarray(t, float), (1, *many)), "q": q, "v": v}
        return evaluate(blank | state | given)


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


@cached_by_identity
def _evaluator(programs: ScenePrograms, name: str, xp: ArrayLibrary) -> tuple[ArrayLoops, dict[str, int]]:
    """Return a program as a function of its arrays, and the lengths of those that it begins with zeros."""
    program, p = attrgetter(name)(programs), programs
    sizes = p.scratch | {"psi": p.row_count, "psi_dot": p.row_count, "terms": p.term_count, "energy": 2}
    sizes |= p.at_rest.sizes if name.startswith("at_rest.") else {}
    arrays = program.arrays | set(ROWS_AND_LOADS)
    return ArrayLoops(program, xp), {x: size for x, size in sizes.items() if x in arrays}
