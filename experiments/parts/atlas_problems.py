"""The mechanisms of the atlas: each with its starts, its duration, and what makes it hard."""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple, TypeAlias

import numpy as np

import udkjax as udk
from experiments.parts.closed_chains import bennett, bricard
from udkjax.study.accuracy import exact_coordinates, pendulum

STARTS = 8  # of each mechanism
RANK = 1e-9  # of the largest singular value; below it, rows depend on others

Model: TypeAlias = udk.Mechanism | udk.ConstrainedSystem


class Problem(NamedTuple):
    """A mechanism that starts in several ways, and runs for `end` seconds."""

    title: str
    build: Callable[[float], Model]  # of the varied number: the bodies are placed and move accordingly
    varied: tuple[float, float]  # its least and its largest value
    end: float  # s
    crosses: bool = False  # whether the rank of the Jacobian falls on the way
    thorough: bool = False  # whether the slow methods run, too
    conserves: bool = True  # whether only errors change the total energy
    # The motion at `ts` from a state, where a formula gives it: coordinates (T, bodies, 3).
    exact: Callable[[udk.Mechanism, np.ndarray, udk.State], np.ndarray] | None = None

    @property
    def mechanism(self) -> Model:
        """The mechanism, in its first start."""
        return _built(self, 0)

    def states(self, starts: int = STARTS) -> list[udk.State]:
        """Return the closed states in which runs start; a single one where nothing is varied."""
        built = [_built(self, k) for k in range(starts if self.varied[0] < self.varied[1] else 1)]
        return [udk.State(np.asarray(one.q0), np.asarray(one.v0)) for one in built]

    @property
    def is_spatial(self) -> bool:
        """True for chains in space, systems of their own: rows depend on others in closed positions only."""
        return isinstance(self.mechanism, udk.ConstrainedSystem)

    @property
    def redundant(self) -> bool:
        """True if rows of the Jacobian depend on others in every position."""
        model = self.mechanism
        if isinstance(model, udk.Mechanism):
            return udk.analyse(model).redundant_rows != ()
        assert model.q0 is not None and model.constraint is not None
        values = udk.singular_values(model, 0.0, model.q0)
        rows = np.size(model.constraint(0.0, model.q0))
        return int((values > RANK * values[0]).sum()) < rows

    @property
    def lengths(self) -> np.ndarray:
        """The scales of x, y and the angle by which errors are divided: the mechanism's length (m) and one radian.

        Of a system, a single one: its coordinates are of the order of one.
        """
        if not isinstance(self.mechanism, udk.Mechanism):
            return np.ones(1)
        length = float(udk.analyse(self.mechanism).length)
        return np.array([length, length, 1.0])


def _parallel(mechanism: udk.Mechanism, ts: np.ndarray, state: udk.State) -> np.ndarray:
    """Return the motion of a parallelogram, by elliptic functions."""
    found = exact_coordinates(mechanism, ts, state.q, state.v)
    assert found is not None
    return found


def _squares(mechanism: udk.Mechanism, ts: np.ndarray, state: udk.State) -> np.ndarray:
    """Return the motion of square four-bars in a row, whose links turn together, and whose couplers stay level."""
    n = sum(name.startswith("coupler") for name in mechanism.body_names)
    moment, inertia = (n + 1) / 2 + n, (n + 1) / 3 + n  # kg m and kg m^2: rods of 1 m and 1 kg
    link, gravity = mechanism.body_names.index("link0"), float(np.hypot(*np.asarray(mechanism.gravity)))
    angle, rate = float(state.q[link, 2]), float(state.v[link, 2])
    turned = angle + pendulum(ts, angle + np.pi / 2, rate, np.sqrt(gravity * moment / inertia))
    e = np.stack([np.cos(turned), np.sin(turned), 0 * turned], axis=-1)
    q = np.empty((len(ts), *state.q.shape))
    for number, name in enumerate(mechanism.body_names):
        k = int(name[4:] if name.startswith("link") else name[7:])
        q[:, number] = [k, 0, 0] + e / 2 if name.startswith("link") else [k + 0.5, 0, 0] + e
        if name.startswith("link"):
            q[:, number, 2] = turned
    return q


@cache
def _built(problem: Problem, start: int) -> Model:
    return problem.build(float(np.linspace(*problem.varied, STARTS)[start]))


def _loaded(mechanism: udk.Mechanism, **forces: udk.ForceElement) -> udk.Mechanism:
    """Return the mechanism, without its drawing, with more force elements, placed and moving as before."""
    return udk.Mechanism(
        mechanism.bodies,
        mechanism.joints,
        drivers=mechanism.drivers,
        forces={**mechanism.forces, **forces},
        gravity=mechanism.gravity,
        name=mechanism.name,
    )


def _damped(rate: float) -> udk.Mechanism:
    """A crank damper that ends swinging within seconds: an ordinary one."""
    four_bar = udk.library.four_bar(angular_velocity=rate)
    return _loaded(four_bar, damper=udk.TorsionSpring(["ground", four_bar.body_names[0]], 0.0, damping=1.0))


def _stiff(degrees: float) -> udk.Mechanism:
    """The same damper, ten thousand times as strong: what is left is a slow creep."""
    four_bar = udk.library.four_bar(np.deg2rad(degrees))
    return _loaded(four_bar, damper=udk.TorsionSpring(["ground", four_bar.body_names[0]], 0.0, damping=1e4))


def _rubbing(rate: float) -> udk.Mechanism:
    four_bar = udk.library.four_bar(angular_velocity=rate)
    pins = [name for name, joint in four_bar.joints.items() if isinstance(joint, udk.Revolute)]
    return _loaded(four_bar, **{f"friction {pin}": udk.Friction(pin, torque=0.2, velocity=0.5) for pin in pins})


def _scaled(factor: float) -> Callable[[float], udk.Mechanism]:
    """The paper's linkage with all lengths times a factor, gravity among them, so that it moves alike."""

    def build(degrees: float) -> udk.Mechanism:
        linkage = udk.library.parallelogram(np.deg2rad(degrees))
        bodies = {
            name: udk.Body(one.mass, one.inertia * factor**2, one.position * factor, one.angle)
            for name, one in linkage.bodies.items()
        }
        joints = {name: udk.Revolute(one.bodies, np.asarray(one.points) * factor) for name, one in linkage.joints.items()}
        return udk.Mechanism(bodies, joints, gravity=linkage.gravity * factor)

    return build


def _driven(rate: float) -> udk.Mechanism:
    """A double pendulum, the upper rod of which a motor swings."""
    pendulum = udk.library.double_pendulum((np.pi / 2, np.pi / 2), (0.0, rate))
    upper = pendulum.body_names[0]
    start = float(pendulum.q0[0, 2])
    motor = udk.Driver(["ground", upper], "angle", udk.Sine(0.5, 3.0, 0.0, start))
    moving = udk.library.double_pendulum((np.pi / 2, np.pi / 2), (1.5, rate))
    return udk.Mechanism(moving.bodies, moving.joints, drivers={"motor": motor}, gravity=pendulum.gravity)


def _slider_crank(rate: float) -> udk.Mechanism:
    return udk.library.slider_crank(angular_velocity=rate, driven=False)


def _four_bar(rate: float) -> udk.Mechanism:
    return udk.library.four_bar(angular_velocity=rate)


def _linkage(degrees: float) -> udk.Mechanism:
    return udk.library.parallelogram(np.deg2rad(degrees))


def _turning(rate: float) -> udk.Mechanism:
    return udk.library.parallelogram(np.pi / 4, rate)


def _peaucellier(degrees: float) -> udk.Mechanism:
    return udk.library.peaucellier(np.deg2rad(degrees))


def _scissors(rate: float) -> udk.Mechanism:
    return udk.library.scissor_lift(angle=np.pi / 3, angular_velocity=rate)


def _gears(rate: float) -> udk.Mechanism:
    return udk.library.planetary_gear(angular_velocity=rate, gravity=9.81)


def _chain(degrees: float) -> udk.Mechanism:
    return udk.library.chain(6, np.deg2rad(degrees))


PROBLEMS: dict[str, Problem] = {
    "hanging": Problem("the paper's linkage, swinging", _linkage, (-50, -30), 10.0, thorough=True, exact=_parallel),
    "crossing": Problem("the paper's linkage, through its singular positions", _linkage, (40, 75), 10.0, True, exact=_parallel),
    "turning": Problem("the paper's linkage, turning", _turning, (6, 12), 5.0, True, exact=_parallel),
    "squares": Problem(
        "two square four-bars in a row (IFToMM A02)",
        lambda rate: udk.library.n_four_bar(2, angular_velocity=rate),
        (-2, -1),
        5.0,
        True,
        exact=_squares,
    ),
    "four-bar": Problem("a crank-rocker", _four_bar, (3, 8), 3.0, thorough=True),
    "trammel": Problem("an elliptic trammel", lambda rate: udk.library.elliptic_trammel(angular_velocity=rate), (1, 4), 5.0),
    "Peaucellier": Problem("Peaucellier's linkage", _peaucellier, (20, 60), 3.0),
    "scissors": Problem("a scissor lift, falling", _scissors, (0.2, 0.5), 0.3),
    "gears": Problem("a planetary gear of three planets", _gears, (1, 4), 5.0),
    "chain": Problem("a chain of six rods", _chain, (30, 90), 1.0),
    "driven": Problem("a double pendulum with a motor", _driven, (0, 2), 3.0, conserves=False),
    "slider-crank": Problem("a slider-crank, let go", _slider_crank, (4, 8), 3.0),
    "squeezer": Problem("Andrews' squeezing mechanism", udk.library.andrews_squeezer, (0.033, 0.033), 0.03, conserves=False),
    "damped": Problem("a four-bar with a damper", _damped, (3, 8), 3.0, conserves=False),
    "stiff": Problem("a four-bar with a damper of 1e4 N m s", _stiff, (50, 70), 1.0, thorough=True, conserves=False),
    "rubbing": Problem("a four-bar with friction in its pins", _rubbing, (3, 8), 3.0, conserves=False),
    "small": Problem("the paper's linkage, a millionth of the size", _scaled(1e-6), (-50, -30), 10.0, exact=_parallel),
    "large": Problem("the paper's linkage, a million times the size", _scaled(1e6), (-50, -30), 10.0, exact=_parallel),
    "Bennett": Problem("Bennett's spatial four-bar", bennett, (1.7, 2.4), 3.0),
    "Bricard": Problem("Bricard's spatial six-bar", bricard, (1.4, 1.7), 2.0),
}
