"""Tableaus of Runge-Kutta methods for q'' = a(t, q, v), explicit or singly diagonally implicit, including the default method."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from udkjax.arrays import ROUNDING, fractions


@dataclass(frozen=True, eq=False)
class Method:
    """A tableau for q'' = a, without stages that only serve interpolation; `of` returns the same object for equal numbers.

    A method is implicit if its `diagonal` is not zero: its first stage is that of an explicit method, each other one has the same
    entry on the diagonal of A, and the last one is the end of the step.
    """

    nodes: np.ndarray  # c, and in the last row 1, the end of the step
    v: np.ndarray  # A, and in the last row b
    q: np.ndarray  # A A, and in the last row b A
    error_v: np.ndarray  # (stages,)
    error_q: np.ndarray
    order: float
    ends: bool  # whether the last stage of an explicit method is the first of the next step
    diagonal: float = 0.0  # entry of A on the diagonal of all stages but the first
    # Weights of the accelerations from which the iteration of each stage begins, for implicit methods.
    predictor: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    _methods: ClassVar[dict[tuple[bytes, ...], "Method"]] = {}  # by their numbers, as operations compare methods by identity

    @classmethod
    def of(
        cls,
        c: np.ndarray,
        stages: Sequence[Any],
        b: np.ndarray,
        error: np.ndarray,
        order: float,
        ends: bool = False,
        diagonal: float = 0.0,
        predictor: Sequence[Any] = (),
    ) -> "Method":
        """Return the method with nodes c, rows of A after the first, weights b, weights of the error estimate, and an order.

        The rows in `stages` are without entries on the diagonal of A, which are all `diagonal` for an implicit method, else zero.
        `predictor` has the same number of rows: weights that extrapolate the accelerations of a stage from those of the stages
        before. If there is a method with equal numbers, it is returned.
        """
        A, P = np.zeros((len(c), len(c))), np.zeros((len(c) if diagonal else 0, len(c)))
        for rows, given in ((A, stages), (P, predictor)):
            for i, coefficients in enumerate(given):
                rows[i + 1, : i + 1] = coefficients
        A += np.diag(np.append(0.0, np.full(len(c) - 1, diagonal)))
        numbers = np.append(c, 1.0), np.vstack([A, b]), _product(np.vstack([A, b]), A), error, _product([error], A)[0]
        numbers = *numbers, float(order), ends, float(diagonal), P
        return cls._methods.setdefault(tuple(np.asarray(x).tobytes() for x in numbers), cls(*numbers))

    @property
    def stages(self) -> int:
        return len(self.error_v)

    @property
    def is_implicit(self) -> bool:
        """True if the accelerations of stages are solutions of equations."""
        return self.diagonal != 0

    @property
    def clearings(self) -> tuple[float, float]:
        """Two fractions of a step that are far from all nodes, the smaller one first.

        The second is the middle of the widest gap between nodes, the first that of the widest gap before it.
        """
        middles, gaps = self._gaps
        widest = np.argmax(gaps)
        return middles[np.argmax(gaps[: max(widest, 1)])], middles[widest]

    @property
    def clearance(self) -> float:
        """Half of the length of the widest gap between nodes, as a fraction of a step."""
        return float(np.max(self._gaps[1])) / 2

    @property
    def _gaps(self) -> tuple[np.ndarray, np.ndarray]:
        """The middles and the lengths of the gaps between nodes."""
        nodes = np.unique(self.nodes[self.nodes <= 1])
        return (nodes[1:] + nodes[:-1]) / 2, np.diff(nodes)


def _product(a: Any, b: np.ndarray) -> np.ndarray:
    """Return a @ b with the same bits on all machines: the order of NumPy's sums depends on the processor.

    Entries that vanish but for the rounding of their terms are zero, and code has no operation for them.
    """

    def entry(row: Any, column: Any) -> float:
        terms = [x * y for x, y in zip(row, column, strict=True)]
        found = math.fsum(terms)
        return found if abs(found) > ROUNDING * math.fsum(map(abs, terms)) else 0.0

    return np.array([[entry(row, column) for column in b.T.tolist()] for row in a])


# The pair of orders 8 and 7 with 13 stages: P. J. Prince, J. R. Dormand, High order embedded Runge-Kutta formulae, J. Comp. Appl.
# Math. 7 (1981) 67-75; `diffrax.Dopri8` without the stage that only serves interpolation.
_ORDER_8 = fractions(
    """14005451/335480064 0 0 0 0 -59238493/1068277825 181606767/758867731 561292985/797845732 -1041891430/1371343529
    760417239/1151165299 118820643/751138087 -528747749/2220607170 1/4"""
)
_ORDER_7 = fractions(
    """13451932/455176623 0 0 0 0 -808719846/976000145 1757004468/5645159321 656045339/265891186 -3867574721/1518517206
    465885868/322736535 53011238/667516719 2/45 0"""
)
DOPRI8 = Method.of(
    fractions("0 1/18 1/12 1/8 5/16 3/8 59/400 93/200 5490023248/9719169821 13/20 1201146811/1299019798 1 1"),
    (
        fractions("1/18"),
        fractions("1/48 1/16"),
        fractions("1/32 0 3/32"),
        fractions("5/16 0 -75/64 75/64"),
        fractions("3/80 0 0 3/16 3/20"),
        fractions("29443841/614563906 0 0 77736538/692538347 -28693883/1125000000 23124283/1800000000"),
        fractions("16016141/946692911 0 0 61564180/158732637 22789713/633445777 545815736/2771057229 -180193667/1043307555"),
        fractions(
            """39632708/573591083 0 0 -433636366/683701615 -421739975/2616292301 100302831/723423059 790204164/839813087
            800635310/3783071287"""
        ),
        fractions(
            """246121993/1340847787 0 0 -37695042795/15268766246 -309121744/1061227803 -12992083/490766935
            6005943493/2108947869 393006217/1396673457 123872331/1001029789"""
        ),
        fractions(
            """-1028468189/846180014 0 0 8478235783/508512852 1311729495/1432422823 -10304129995/1701304382
            -48777925059/3047939560 15336726248/1032824649 -45442868181/3398467696 3065993473/597172653"""
        ),
        fractions(
            """185892177/718116043 0 0 -3185094517/667107341 -477755414/1098053517 -703635378/230739211
            5731566787/1027545527 5232866602/850066563 -4093664535/808688257 3962137247/1805957418 65686358/487910083"""
        ),
        fractions(
            """403863854/491063109 0 0 -5068492393/434740067 -411421997/543043805 652783627/914296604 11173962825/925320556
            -13158990841/6184727034 3936647629/1978049680 -160528059/685178525 248638103/1413531060 0"""
        ),
    ),
    _ORDER_8,
    _ORDER_8 - _ORDER_7,
    order=8,
)

# The singly diagonally implicit pair of orders 5 and 4 with 7 stages, both stiffly accurate: A. Kvaerno, Singly diagonally
# implicit Runge-Kutta methods with an explicit first stage, BIT 44 (2004) 489-502; `diffrax.Kvaerno5`, with its predictors.
_STAGES = (
    (0.26,),
    (0.13, 0.84033320996790809),
    (0.22371961478320505, 0.47675532319799699, -0.06470895363112615),
    (0.16648564323248321, 0.10450018841591720, 0.03631482272098715, -0.13090704451073998),
    (0.13855640231268224, 0.0, -0.04245337201752043, 0.02446657898003141, 0.61943039072480676),
    (0.13659751177640291, 0.0, -0.05496908796538376, -0.04118626728321046, 0.62993304899016403, 0.06962479448202728),
)
_WEIGHTS = np.array([*_STAGES[-1], 0.26])
KVAERNO5 = Method.of(
    np.array([0.0, 0.52, 1.230333209967908, 0.8957659843500759, 0.43639360985864756, 1.0, 1.0]),
    _STAGES,
    _WEIGHTS,
    _WEIGHTS - np.array([*_STAGES[-2], 0.26, 0.0]),
    order=5,
    diagonal=0.26,
    predictor=(
        (1.0,),
        (-1.366025403784441, 2.3660254037844357),
        (-0.19650552613122207, 0.8113579546496623, 0.38514757148155954),
        (0.10375304369958693, 0.937994698066431, -0.04174774176601781, 0.0),
        (-0.17281112873898072, 0.6235784481025847, 0.5492326806363959, 0.0, 0.0),
        (*_STAGES[-2], 0.26),
    ),
)

EULER = Method.of(fractions("0"), (), fractions("1"), fractions("1"), order=1)
