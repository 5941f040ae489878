"""A scene of mixed features with its runs, and the comparison of two runs."""

import functools
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import udkjax as udk
from experiments.parts.mixed_scenes import LEAST_RANK, build, events
from experiments.parts.random_scenes import RandomScene, state_of
from experiments.parts.reference_equations import evaluate
from experiments.parts.tally import Tally

SPAN, TIMES = 0.8, 9  # of a run, in the scene's own time, and its number of outputs
LOOSE, MIDDLE, TIGHT = 1e-6, 1e-9, 1e-11  # tolerances of integration
STEPS, EVENTS = 100_000, 300  # most of a run: where a damper is just too weak for implicit steps, explicit ones are 1/50,000 s
ALONG, SINGULAR = 400, 0.02  # times along a run, and the smallest singular value, of the largest, near a change point
DIFFERENCE = 1e-6  # allowed between two runs at MIDDLE, or GROWTH times what TIGHT changes, in scenes that amplify errors
GROWTH = 30.0
# Numbers that are varied and differentiated: they open no loop. Of a friction with a static coefficient this one alone.
VARIED = re.compile(r"body\..*\.(mass|inertia)|force\..*\.(stiffness|damping|most|force|drag|torque|value|coefficient)")
MOST_VARIED = 4
ANY_JOINT = re.compile(r"^.* (?=sticks$)")


class Failure(NamedTuple):
    """A comparison that does not hold: the property, the call that draws the scene, the error, and the circumstances."""

    name: str
    at: str
    error: float
    detail: str


class Case:
    """A scene, its mechanism and events, and runs of it; comparisons go into a tally, and failures into a list."""

    def __init__(self, scene: RandomScene, tally: Tally, failures: list[Failure], tolerances: dict[str, float]):
        self.scene, self.tally, self.failures, self.tolerances = scene, tally, failures, tolerances
        self.table, self.label = scene.table, f"mixed_scene{scene.seed}"
        self.mechanism, self.events = build(scene.table), events(scene.table)
        self.state = udk.State(*state_of(scene.table))
        self.ts = np.linspace(0.0, SPAN, TIMES)
        self.rng = np.random.default_rng([*scene.seed, 9])

    @functools.cached_property
    def kinds(self) -> set[str]:
        """Types of force elements, laws of friction, events and their actions."""
        forces = {f["type"] for f in self.table["force"]} | {f["law"] for f in self.table["force"] if "law" in f}
        return forces | {e["type"] for e in self.table["event"]} | {e.get("action", "") for e in self.table["event"]}

    @functools.cached_property
    def has_events(self) -> bool:
        """Return True if a run may have events, those of set-valued friction included."""
        return bool(self.table["event"]) or "set-valued" in self.kinds

    def run(self, tol: float = MIDDLE, ts: Any = None, state: Any = None, mechanism: Any = None, **settings: Any) -> Any:
        """Integrate the scene, or a variation of it."""
        scene = self.mechanism if mechanism is None else mechanism
        chosen: dict[str, Any] = {"throw": False, "max_steps": STEPS} | settings
        given = chosen.pop("events", self.events)
        if given or self.has_events:
            chosen |= {"events": given or None, "max_events": EVENTS}
        return udk.simulate(scene, self.ts if ts is None else ts, self.state if state is None else state, tol, tol, **chosen)

    @functools.cached_property
    def loose(self) -> Any:
        return self.run(LOOSE)

    @functools.cached_property
    def middle(self) -> Any:
        return self.run(MIDDLE)

    @functools.cached_property
    def tight(self) -> Any:
        return self.run(TIGHT)

    @functools.cached_property
    def growth(self) -> float:
        """Factor of the errors that are allowed: the scene's own amplification of the tolerance, at least 1."""
        return max(1.0, GROWTH * difference(self.middle, self.tight) / DIFFERENCE)

    def check(self, name: str, error: float, detail: str = "") -> None:
        """Count a comparison; list it if the error exceeds the property's tolerance, unless no motion is definite."""
        fails = not error <= self.tolerances[name]
        if fails and self.is_indefinite:
            self.tally.leave_out("friction by load at a change point, where loads have no bound (docs/limits.md)")
            return
        self.tally.add(name, error, self.label)
        if fails:
            self.failures.append(Failure(name, self.label, float(error), detail))

    @functools.cached_property
    def is_indefinite(self) -> bool:
        """Return True if friction depends on loads, and the rows come near to losing rank along the run."""
        if not any("coefficient" in force for force in self.table["force"]):
            return False
        run = self.run(ts=np.linspace(0.0, float(self.middle.time), ALONG))
        sigma = np.array([self._singular_values(q) for q in np.asarray(run.q) if np.isfinite(q).all()])
        rank = int(np.sum(sigma[0] > LEAST_RANK * sigma[0, 0])) if sigma.size else 0
        return rank > 0 and bool(np.min(sigma[:, rank - 1] / sigma[:, 0]) < SINGULAR)

    def _singular_values(self, q: np.ndarray) -> np.ndarray:
        terms = evaluate(self.table, 0.0, q, 0 * q)
        rows = terms.psi_q / np.sqrt(terms.mass)
        return np.linalg.svd(rows, compute_uv=False) if len(rows) else np.zeros(0)

    def check_runs(self, name: str, found: Any, right: Any, detail: str = "") -> None:
        """Compare two runs: their states, by the scene's own growth of errors, and how they ended."""
        self.check(name, difference(found, right) / self.growth, f"{detail} {ending(found)} {ending(right)}")
        self.check("endings", float(found.result != right.result), f"{name} {detail} {ending(found)} {ending(right)}")

    @functools.cached_property
    def varied(self) -> dict[str, float]:
        """Some of the numbers that a run depends on, by name."""
        static = {name.rsplit(".", 1)[0] for name in self.mechanism.parameters() if name.endswith("static_coefficient")}
        names = [
            name
            for name, value in self.mechanism.parameters().items()
            if VARIED.fullmatch(name) and name.rsplit(".", 1)[0] not in static and np.ndim(value) == 0 and float(value) != 0.0
        ]
        chosen = self.rng.permutation(names)[:MOST_VARIED]
        return {str(name): float(self.mechanism.parameters()[str(name)]) for name in chosen}

    def with_factors(self, x: Any) -> udk.Mechanism:
        """Return the mechanism whose varied numbers are multiplied by x."""
        return self.mechanism.with_parameters({name: value * x[k] for k, (name, value) in enumerate(self.varied.items())})

    def end(self, tol: float = TIGHT) -> Callable[[Any], Any]:
        """Return a number of the last state as a function of the factors of the varied numbers."""
        wq, wv = np.random.default_rng([*self.scene.seed, 10]).standard_normal((2, len(self.table["body"]), 3))

        def number(x: Any) -> Any:
            found = self.run(tol, [0.0, SPAN], mechanism=self.with_factors(x))
            return jnp.sum(wq * found.q[-1]) + jnp.sum(wv * found.v[-1])

        return number


def states(run: Any) -> Float[np.ndarray, "T bodies 6"]:
    """Return positions and velocities of a run side by side."""
    return np.concatenate([np.asarray(run.q), np.asarray(run.v)], axis=-1)


def difference(found: Any, right: Any) -> float:
    """Return the largest difference of two runs, relative to the states; infinite if only one has a state at a time."""
    x, y = (run if isinstance(run, np.ndarray) else states(run) for run in (found, right))
    ended = np.isfinite(y)
    if np.any(np.isfinite(x) != ended):
        return np.inf
    return float(np.max(np.abs(x - y)[ended]) / (1.0 + np.max(np.abs(y[ended])))) if ended.any() else 0.0


def ending(run: Any) -> str:
    """Return how a run ended, by which engine, and its events."""
    return f"{run.result.name} {run.settings['engine']} {happened(run)}"


def happened(run: Any) -> list[tuple[str, float]]:
    """Return the names and times of the events of a run."""
    if run.events is None:
        return []
    return [(run.events.names[int(k)], float(t)) for k, t in zip(run.events.index, run.events.time, strict=True)]


def difference_of_events(one: Any, two: Any) -> float:
    """Return the largest difference of the times of events, infinite where other events happened.

    Of joints that come to rest at one instant, as all of a linkage with one degree of freedom do, the first in the list is any.
    """
    a, b = (sorted((ANY_JOINT.sub("", name), t) for name, t in happened(run)) for run in (one, two))
    if [name for name, _ in a] != [name for name, _ in b]:
        return np.inf
    return max((abs(x - y) for (_, x), (_, y) in zip(a, b, strict=True)), default=0.0)


def extrapolated(f: Callable[[Any], Any], x: np.ndarray, along: np.ndarray, step: float) -> tuple[Any, float]:
    """Return the derivative of f along a direction by central differences at three steps, and an estimate of its error."""
    coarse, middle, fine = (
        (np.asarray(f(x + h * along)) - np.asarray(f(x - h * along))) / (2 * h) for h in (step, step / 2, step / 4)
    )
    once = (4 * middle - coarse) / 3, (4 * fine - middle) / 3
    best = (16 * once[1] - once[0]) / 15
    error = max(np.max(np.abs(best - once[1])), np.max(np.abs(once[1] - once[0])) / 50)
    return best, float(error)


def stack(trees: Sequence[Any]) -> Any:
    """Return trees of one structure as one tree of stacked leaves."""
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(x) for x in leaves]), *trees)
