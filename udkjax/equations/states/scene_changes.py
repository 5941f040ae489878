"""The constraints that hold at the output times of a run whose events change the scene, and quantities of its states.

Joints that events release, add or lock, and contacts at rest, are switched constraints of one mechanism (terms/switches.py), as
in the run itself. At each output time they are on or off, and joints that events have added have the numbers of the state at
which they were added. Reactions and accelerations along a `Solution` are those of this mechanism.
"""

import pickle
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from udkjax.annotations import TreeDef
from udkjax.arrays import is_array, is_traced, number
from udkjax.equations.friction import rubbing
from udkjax.equations.friction.sticking_state import known_sticking
from udkjax.equations.laws.abstract_system import times_of
from udkjax.equations.laws.udwadia_kalaba import Baumgarte
from udkjax.equations.rows.analysis import Analysis, analyse
from udkjax.equations.terms.switches import switch, switched, with_switches
from udkjax.programs.identity_cache import cached_by_identity, is_concrete
from udkjax.requirements import ArgumentError
from udkjax.scene.elements.drivers import Polynomial
from udkjax.scene.elements.friction import Friction
from udkjax.scene.elements.joints import Constraint, Joint
from udkjax.scene.mechanism import Mechanism

OF_SCENE = "constraints_of_the_scene"  # attribute of datasets: how many constraints of `holds`, the first ones; -1: none changes


class SceneChanges(eqx.Module):
    """The constraints that hold at the output times (T) of a run, and the joints that its events have added.

    The constraints (C) are first those of the scene that events release, then the joints that events add, A, then contacts.
    If the joints are unknown, as in a run that was read from a dataset, or pickled with a function that cannot be pickled, no
    loads are known while one of them holds.
    """

    holds: Bool[Array | np.ndarray, "T C"]
    places: Float[Array | np.ndarray, "T A n"]  # coordinates at which each added joint was added last
    numbers: tuple[Array, ...]  # of the added joints, the contacts, and the friction of contacts
    form: "_Form | None" = eqx.field(static=True)  # the structure of added joints, contacts and their friction; None: unknown
    names: tuple[str, ...] = eqx.field(static=True)  # the names of the constraints in the mechanism with all of them
    public: tuple[str, ...] = eqx.field(static=True)  # the names by which results list them
    scene_constraint_count: int = eqx.field(static=True)  # number of the constraints that belong to the scene
    sticking: tuple[str, ...] = eqx.field(static=True, default=())  # the names of contacts with friction in `Solution.sticking`

    @property
    def by_name(self) -> dict[str, Bool[Array, "T"]]:
        """Masks of the output times at which constraints hold, by the names by which results list the constraints."""
        found: dict[str, Any] = {}
        for k, name in enumerate(self.public):
            found[name] = found[name] | self.holds[..., k] if name in found else self.holds[..., k]
        return found

    @property
    def elements(self) -> tuple[list[Any], dict[str, Friction]]:
        """The joints that events add and contacts, and the friction of contacts."""
        return ([], {}) if self.form is None else self.form.put(self.numbers)

    @property
    def is_known(self) -> bool:
        """True if the joints that events add are known, and so are contacts."""
        return self.form is not None

    def __getstate__(self) -> dict[str, Any]:
        elements = self.elements if self.is_known else None
        try:
            pickle.dumps(elements)
        except Exception:  # a lambda expression in a condition, or anything in users' classes
            elements = None
        return vars(self) | {"numbers": (), "form": None, "elements": elements}

    def __setstate__(self, state: dict[str, Any]) -> None:
        elements = state.pop("elements")
        numbers, form = ((), None) if elements is None else numbers_and_form(*elements)
        for name, value in (state | {"numbers": numbers, "form": form}).items():
            object.__setattr__(self, name, value)

    @staticmethod
    def write(changes: "SceneChanges | None", data: Any) -> None:
        """Add `holds`, over time and constraint, to the xarray Dataset of a run; None: the run has not changed the scene."""
        data.attrs[OF_SCENE] = -1 if changes is None else changes.scene_constraint_count
        if changes is not None:
            data["holds"] = ("time", "constraint"), np.asarray(changes.holds).astype(np.int8)
            data.coords["constraint"] = list(changes.public)
            data["holds"].attrs = {"long_name": "1 where a constraint that events change holds"}

    @classmethod
    def read(cls, data: Any, had_events: bool) -> "SceneChanges | None":
        """Return the changes that `write` has added to a dataset, in which added joints are unknown; None if nothing has changed.

        Args:
            data: The dataset. If `write` has added nothing, an older version has written it.
            had_events: True if its run had events.
        """
        scene_constraint_count, times = int(data.attrs.get(OF_SCENE, 0 if had_events else -1)), len(data["time"])
        if scene_constraint_count < 0:
            return None
        holds, names = np.ones((times, 1), bool), ("",)  # something has changed
        if "holds" in data.variables:
            holds, names = np.asarray(data["holds"]) > 0, tuple(map(str, data["constraint"].values))
        return cls(holds, np.zeros((times, 0, 0)), (), None, names, names, scene_constraint_count)

    def scene(self, mechanism: Mechanism) -> Mechanism:
        """Return the mechanism with all constraints of the run, those that events change with a switch."""
        joints, friction = self.elements
        known = [name for name in self.names[: self.scene_constraint_count] if name in mechanism.constraints]
        others = dict(zip(self.names[self.scene_constraint_count :], joints, strict=False))
        if is_concrete(mechanism, *joints, *friction.values()):
            return _concrete_scene(mechanism, tuple(known), tuple(others), tuple(friction), *joints, *friction.values())
        return with_switches(mechanism, known, others, friction)

    def constraints_of(self, mechanism: Mechanism) -> dict[str, list[str]]:
        """Return the names of the constraints of `scene`, listed by their names in results; the mechanism's own come first."""
        found = {name: [name] for name in mechanism.constraints}
        for name, public in list(zip(self.names, self.public, strict=True))[self.scene_constraint_count :]:
            found.setdefault(public, []).append(name)
        return found

    def rows_that_hold(self, mechanism: Any) -> Bool[Array, "T m"]:
        """Return a mask over output times and rows of a mechanism: True where the constraint of the row holds."""
        own = self.names[: self.scene_constraint_count]
        owners = [name for name, _ in analyse(mechanism).row_names]
        places = np.array([own.index(name) if name in own else self.scene_constraint_count for name in owners], int)
        always = jnp.ones((len(self.holds), 1), bool)
        return jnp.concatenate([self.holds[:, : self.scene_constraint_count], always], axis=1)[:, places]

    @property
    def are_released(self) -> Bool[Array, "T"]:
        """A mask of the output times at which a constraint of the scene is released."""
        return ~jnp.all(self.holds[:, : self.scene_constraint_count], axis=1)

    @property
    def is_unknown(self) -> Bool[Array, "T"]:
        """A mask of the output times at which an added joint or a contact holds whose numbers are not known."""
        return jnp.any(self.holds[:, self.scene_constraint_count :], axis=1) & (not self.is_known)


class _Form(NamedTuple):
    """The structure of added joints, contacts and their friction, and their leaves other than arrays; hashable."""

    tree: TreeDef
    others: tuple[Any, ...]  # None in place of arrays

    def put(self, numbers: Sequence[Array]) -> tuple[list[Any], dict[str, Friction]]:
        """Return the added joints and contacts, and the friction of contacts, with the arrays `numbers`."""
        following = iter(numbers)
        return jax.tree.unflatten(self.tree, [next(following) if x is None else x for x in self.others])


def numbers_and_form(joints: Sequence[Constraint], friction: Mapping[str, Friction]) -> tuple[tuple[Array, ...], _Form]:
    """Return the fields `numbers` and `form` of `SceneChanges`.

    Args:
        joints: The joints that events add, without numbers of the state, and contacts.
        friction: The friction of contacts, by the name of their joint.
    """
    leaves, tree = jax.tree.flatten((list(joints), dict(friction)))
    return tuple(x for x in leaves if is_array(x)), _Form(tree, tuple(None if is_array(x) else x for x in leaves))


@cached_by_identity
def _concrete_scene(
    mechanism: Mechanism, of_scene: tuple[str, ...], names: tuple[str, ...], rubbing_names: tuple[str, ...], *elements: Any
) -> Mechanism:
    others = dict(zip(names, elements, strict=False))
    return with_switches(mechanism, of_scene, others, dict(zip(rubbing_names, elements[len(names) :], strict=True)))


class KnownState(eqx.Module):
    """The constraints of a run at one of its output times, or, with a leading axis T, at all of them."""

    sticking: Bool[Array, "F"] | None = None  # the joints that stick, in the order of `sticking_joints`; None: the law decides
    active: Float[Array, "C"] | None = None  # whether each switched constraint holds; None: the scene does not change
    added: tuple[tuple[Array, ...], ...] = ()  # the numbers of the joints that events have added
    unknown: Bool[Array, ""] | None = None  # whether the constraints that hold are not known
    driven: Float[Array, "3"] | None = None  # coefficients of the motion of a driver; None: drivers move in time
    names: tuple[str, ...] = eqx.field(static=True, default=())  # the switched constraints
    names_added: tuple[str, ...] = eqx.field(static=True, default=())
    driver: str = eqx.field(static=True, default="")

    def put_in(self, mechanism: Mechanism) -> Mechanism:
        """Return the mechanism with the constraints of this state; gravity, and so all loads, are NaN if these are not known."""
        if self.driven is not None:
            k = mechanism.driver_names.index(self.driver)
            mechanism = eqx.tree_at(lambda m: m._drivers[k].motion.coefficients, mechanism, self.driven)
        if self.active is None:
            return mechanism
        for name, numbers in zip(self.names_added, self.added, strict=True):
            index = mechanism.joint_names.index(name)
            arrays, rest = eqx.partition(mechanism._joints[index], is_array)
            joint = eqx.combine(jax.tree.unflatten(jax.tree.structure(arrays), numbers), rest)
            mechanism = eqx.tree_at(lambda m, index=index: m._joints[index], mechanism, joint)
        mechanism = switch(mechanism, self.names, list(self.active))
        if self.unknown is None:
            return mechanism
        gravity = jnp.where(self.unknown, jnp.nan, mechanism.gravity)
        return eqx.tree_at(lambda m: m._source.gravity, mechanism, gravity)


class Knowledge(NamedTuple):
    """Knowledge of constraints along a motion, at its T times: joints that stick, changes by events, and a driver's motion."""

    sticking: Bool[Array, "T F"] | None
    changes: SceneChanges | None
    driver: str = ""  # the one whose motion differs from state to state
    driven: Float[Array, "T 3"] | None = None  # the coefficients of its motion

    @property
    def is_constant(self) -> bool:
        """True if the same constraints and motions hold at all times."""
        return self.changes is None and self.driven is None

    def states(self, mechanism: Mechanism) -> KnownState:
        """Return the known states at all times, with a leading axis T, for the mechanism with all constraints of the run."""
        changes = self.changes
        if changes is None:
            return KnownState(self.sticking, driven=self.driven, driver=self.driver)
        known = [k for k, name in enumerate(changes.names) if name in mechanism.constraints]
        count = changes.places.shape[1] if changes.is_known else 0
        joints, names = changes.elements[0][:count], changes.names[changes.scene_constraint_count :][:count]

        def numbers(joint: Joint, q: Array) -> tuple[Array, ...]:
            frames = rubbing.frames(mechanism, q, jnp.zeros_like(q))
            completed = switched(jax.tree.map(number, joint.complete(*(frames[name] for name in joint.frame_names))))
            return tuple(jax.tree.leaves(eqx.filter(completed, is_array)))

        return KnownState(
            sticking=self.sticking,
            active=jnp.asarray(changes.holds)[:, np.array(known, int)].astype(float),
            added=tuple(jax.vmap(lambda q, x=x: numbers(x, q))(changes.places[:, k]) for k, x in enumerate(joints)),
            unknown=None if changes.is_known else changes.is_unknown,
            names=tuple(changes.names[k] for k in known),
            names_added=names,
        )


class SceneAlong(NamedTuple):
    """A mechanism with all constraints that hold along a motion, its analysis, and the times at which each of them holds."""

    mechanism: Mechanism
    analysis: Analysis
    knowledge: Knowledge
    names: Mapping[str, Sequence[str]] | None  # its constraints by the name by which results list them; None: by their own
    ts: Any  # times (T,) of loads and of motions
    is_kinematic: bool = False  # whether the motion is that of a `Kinematics` over the values of a driver

    def gains(self, stabilization: Baumgarte | None) -> Baumgarte | None:
        """Return the given gains of Baumgarte's terms; None for a kinematic motion, which has no such terms."""
        return None if self.is_kinematic else stabilization


def scene_along(mechanism: Any, solution: Any) -> SceneAlong:
    """Return the mechanism in which the states of a motion are evaluated, and the constraints that hold.

    Args:
        mechanism: The scene.
        solution: A `Solution`, whose events may have changed the scene, or other states over time.

    Raises:
        ArgumentError: the solution's times do not belong to its `scene_changes`.
    """
    analysis, ts = analyse(mechanism), times_of(solution)
    if getattr(solution, "values_of", None) is not None and mechanism.driver_names:
        return _over_values(mechanism, solution, analysis, ts)
    changes: SceneChanges | None = getattr(solution, "scene_changes", None)
    if changes is None:
        sticking = getattr(solution, "sticking", None)
        known = known_sticking(mechanism, sticking) if sticking else None
        return SceneAlong(mechanism.without_origin, analysis, Knowledge(known, None), None, ts)
    if len(changes.holds) != len(solution.ts):
        count = f"{len(solution.ts)} times, and its scene_changes {len(changes.holds)}"
        raise ArgumentError(f"solution: it has {count}: select times of all fields, or leave scene_changes out")
    whole = changes.scene(mechanism)
    contacts = dict(zip(changes.elements[1], changes.sticking, strict=False))
    sticking = getattr(solution, "sticking", None) or {}
    sticking = sticking | {joint: sticking[name] for joint, name in contacts.items() if name in sticking}
    knowledge = Knowledge(known_sticking(whole, sticking), changes)
    return SceneAlong(whole, analysis.with_rows_of(whole), knowledge, changes.constraints_of(mechanism), ts)


def _over_values(mechanism: Mechanism, motion: Any, analysis: Analysis, ts: np.ndarray) -> SceneAlong:
    """Return the mechanism along a `Kinematics` over the values of a driver.

    At time 0 its driver has the value, rate and acceleration of each state; all other drivers are at rest.
    """
    name, scene = motion.values_of, mechanism.without_origin
    if name not in mechanism.driver_names:
        return SceneAlong(_with_motions(scene), analysis, Knowledge(None, None), None, ts, True)
    numbers = motion.values, motion.rate, motion.acceleration
    if not is_traced(numbers):
        rates = np.unique(np.stack([np.asarray(x, float) for x in numbers[1:]]), axis=1)
        if rates.shape[1] == 1:
            scene = _with_motions(scene, name, *rates[:, 0].tolist())
            return SceneAlong(scene, analysis, Knowledge(None, None), None, ts, True)
    value, rate, acceleration = (jnp.asarray(x) for x in numbers)
    coefficients = jnp.stack([value, rate, 0.5 * acceleration], -1)
    return SceneAlong(_with_motions(scene, name), analysis, Knowledge(None, None, name, coefficients), None, ts, True)


@cached_by_identity(within_trace=True)
def _with_motions(mechanism: Mechanism, name: str = "", rate: float = 0.0, acceleration: float = 0.0) -> Mechanism:
    """Return the mechanism in which the driver `name` has a rate and an acceleration at time 0, and all others are at rest."""
    moving, resting = Polynomial(np.array([0.0, rate, 0.5 * acceleration])), Polynomial(np.zeros(1))
    drivers = mechanism.drivers.items()
    return mechanism.with_drivers(
        {key: eqx.tree_at(lambda d: d.motion, x, moving if key == name else resting) for key, x in drivers}
    )
