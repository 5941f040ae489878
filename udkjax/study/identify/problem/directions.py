"""Directions along which derivatives are compared with differences: vectors of unit length in the space of all unknowns."""

from collections.abc import Mapping
from typing import Annotated, Any, TypeAlias

import numpy as np
from jaxtyping import Float

from udkjax.argument_types import ArgumentRequirement
from udkjax.requirements import ArgumentTypeError, GivenArguments, describe, require_number
from udkjax.study.identify.problem.fit_problem import FitProblem
from udkjax.study.identify.records.records import IdentificationError
from udkjax.wording import quote, suggestion

RANDOM_DIRECTIONS = 3  # number of directions in which all unknowns change


def _require_directions(name: str, value: Any, given: GivenArguments) -> None:
    if not isinstance(value, Mapping) or not all(isinstance(x, str) and isinstance(y, Mapping) for x, y in value.items()):
        example = '{"both": {"body.a.mass": 1.0, "body.b.mass": -1.0}}'
        raise ArgumentTypeError(f"{name} must map names to changes of unknowns, such as {example}, {describe(value)}")
    for direction, changes in value.items():
        for unknown, change in changes.items():
            require_number(f"{name}[{direction!r}][{unknown!r}]", change, infinite=True)


# changes of unknowns by name, by the name of the direction
Directions: TypeAlias = Annotated[
    Mapping[str, Mapping[str, float]], ArgumentRequirement("changes of unknowns by name", _require_directions)
]


def usual_directions(problem: FitProblem, seed: int) -> tuple[tuple[str, ...], Float[np.ndarray, "D K"]]:
    """Return the names of the default directions and unit vectors: each unknown by itself, and random combinations of all."""
    names = problem.all_names[: problem.K - problem.constrained]
    random = np.random.default_rng(int(seed)).standard_normal((RANDOM_DIRECTIONS if problem.K > 1 else 0, problem.K))
    directions = np.concatenate([np.eye(problem.K)[: len(names)], random / np.linalg.norm(random, axis=1, keepdims=True)])
    return (*names, *(f"random direction {k + 1}" for k in range(len(random)))), directions


def given_directions(
    problem: FitProblem, z: Float[np.ndarray, "K"], given: Directions
) -> tuple[tuple[str, ...], Float[np.ndarray, "D K"]]:
    """Return the names of given directions, and unit vectors in the space of z.

    `given` has the changes of unknowns, in their units, for each direction; z is the point at which these are converted.

    Raises:
        IdentificationError: lists every mistake, such as a direction that names no unknown.
    """
    P, problems = len(problem.unknowns.names), []
    per_unit = np.ones(problem.K)  # dz over the change of an unknown
    per_unit[:P] = 1 / problem.unknowns.dx_dz(z[:P])
    directions = np.zeros((len(given), problem.K))
    for row, (name, changes) in zip(directions, given.items(), strict=True):
        unknown = [key for key in changes if key not in problem.all_names]
        problems += [f"directions: {quote(name)}: no unknown {quote(key)}{suggestion(key, problem.all_names)}" for key in unknown]
        for key in changes.keys() - set(unknown):
            k = problem.all_names.index(key)
            row[k] = float(changes[key]) * per_unit[k]
        size = np.linalg.norm(row)
        if not unknown and not (np.isfinite(size) and size > 0):
            problems.append(f"directions: {quote(name)} must change an unknown by a finite number")
        else:
            row /= size or 1.0
    if not given:
        problems.append("directions: there are none")
    if problems:
        raise IdentificationError(problems)
    return tuple(given), directions
