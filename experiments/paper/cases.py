"""The runs of the paper's study, and what would have been better: which method, which integrator, which numbers.

A `Case` is one run. Cases of one `Program` share a compilation: the paper's methods, tolerances, thresholds, gains, times and the
initial state are traced numbers, and no stabilization is Baumgarte's with gains of zero.
"""

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

METHODS = ("SVD", "Varga", "Greville", "Householder", "GramSchmidt")
TOLERANCES = (1e-10, 1e-8, 1e-6)
GAINS = (1000.0, 100.0)  # alpha, beta of the paper, 1/s
FIRST_STEP = 0.66e-2  # s, of the paper
END = 20.0  # s
# Relative to the largest singular value of D at the start: a twentieth of the smallest sigma_11, and above any small drift.
RANK_HELD = 1e-2
SMALL_GAINS = (2.0, 3.0, 5.0)  # alpha = beta, 1/s: above the rate at which a drift grows
LAW_GAINS = (0.5, 1.0)  # alpha = beta, 1/s: too small, so that the drift grows, at a rate that the law says
WORK_GAIN = 3.0  # alpha = beta of the work-precision runs: something must hold the constraints, or every run is lost
WORK_TOLERANCES = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11)


class Program(NamedTuple):
    """The key of its compiled program."""

    method: str  # of `METHODS`, the first stands for all: which one is a number
    solver: str
    projected: bool

    @property
    def seconds(self) -> float:
        """The rough time of that: XLA compiles the loops of multistep methods, all else is machine code."""
        return 6.0 if self.solver in ("Adams", "BDF") else 1.0


@dataclass(frozen=True)
class Case:
    """One run of the study."""

    group: str  # "paper", "other integrators", "rank held", "small gains", "fixed rows", "default", "law", "start" or "work"
    method: str
    solver: str
    tol: float
    rank_tol: float | None = None  # absolute, in the units of D; None: as `RANK_HELD`, or the method's own
    alpha: float = 0.0
    beta: float = 0.0
    projected: bool = False
    end: float = END
    start: int = 0  # 0: the exact initial state; else the number of one that differs from it by rounding

    @property
    def program(self) -> Program:
        """The program that runs it."""
        return Program(METHODS[0] if self.method in METHODS else self.method, self.solver, self.projected)

    @property
    def stiff(self) -> bool:
        """True if the gains dictate the step, not the motion."""
        return self.alpha > 100

    @property
    def timed(self) -> bool:
        """True if its time is shown: not of runs that show only drift, nor if Python takes part."""
        return self.group not in ("start", "law") and self.solver != "VODE"

    @property
    def seconds(self) -> float:
        """The rough time that it takes, for estimates of the time left."""
        return 6.0 * self.end / END if self.stiff else 0.3


@dataclass(frozen=True)
class Scope:
    """The part of the study that is done."""

    name: str
    methods: tuple[str, ...] = METHODS
    tolerances: tuple[float, ...] = TOLERANCES
    stiff_end: float = END  # s, of the runs with the paper's gains
    max_steps: int = 200_000
    starts: int = 20
    work: tuple[tuple[str, str, bool], ...] = ()  # method, solver, whether it is projected
    work_tolerances: tuple[float, ...] = WORK_TOLERANCES
    repeats: int = 5  # of a run, for its time
    patience: float = 3.0  # s: what took longer is timed once
    others: tuple[str, ...] = ()  # integrators by which the runs without stabilization are made again
    gains_for: tuple[str, ...] = METHODS  # the methods that are run with small gains
    better: bool = True  # whether what would have been better is done at all


INTEGRATORS = ("Adams", "BDF", "Verner65", "Dopri8", "Tsit5")
_WORK = tuple((method, solver, False) for method, solver in product((*METHODS, "Elimination"), INTEGRATORS))
FULL = Scope(
    "full",
    work=(*_WORK, ("Auto", "Dopri8", True)),
    others=("VODE", *INTEGRATORS[1:]),
)
QUICK = Scope(
    "quick",
    stiff_end=2.0,
    max_steps=10_000,
    starts=10,
    work=(*(("SVD", solver, False) for solver in ("Adams", "Dopri8", "Tsit5")), ("Auto", "Dopri8", True)),
    work_tolerances=WORK_TOLERANCES[::2],
    others=("VODE", "Dopri8"),
    repeats=3,
    patience=0.5,
    gains_for=("SVD",),
)
SMOKE = Scope("smoke", ("Greville",), (1e-6,), stiff_end=0.1, max_steps=1_000, starts=0, repeats=1, gains_for=(), better=False)


def plan(scope: Scope, solver: str = "Adams") -> list[Case]:
    """Return all runs, the paper's first. `solver` is what stands for the paper's Adams-Moulton."""
    alpha, beta = GAINS
    methods, gains_for = scope.methods, scope.gains_for
    cases = [Case("paper", method, solver, tol, tol) for tol, method in product(scope.tolerances, methods)]
    cases += [
        Case("paper", method, solver, tol, tol, alpha, beta, end=scope.stiff_end)
        for tol, method in product(scope.tolerances, methods)
    ]
    if scope.better:
        for tol in scope.tolerances:
            cases += [Case("rank held", method, solver, tol) for method in methods]
            for integrator in scope.others:
                chosen = methods if integrator == "VODE" else methods[:1]
                cases += [Case("other integrators", method, integrator, tol, tol) for method in chosen]
                cases += [Case("rank held", method, integrator, tol) for method in chosen]
                if integrator == "VODE":
                    cases.append(Case("other integrators", chosen[0], integrator, tol, tol, alpha, beta, end=scope.stiff_end))
            cases += [Case("small gains", m, solver, tol, tol, gain, gain) for gain, m in product(SMALL_GAINS, gains_for)]
            cases += [Case("fixed rows", "Elimination", solver, tol), Case("default", "Auto", "Dopri8", tol, projected=True)]
            cases += [Case("law", scope.methods[0], solver, tol, None, gain, gain) for gain in LAW_GAINS]
            cases += [Case("start", scope.methods[0], solver, tol, start=k + 1) for k in range(scope.starts)]
    for (method, integrator, projected), tol in product(scope.work, scope.work_tolerances):
        gain = 0.0 if projected else WORK_GAIN
        cases.append(Case("work", method, integrator, tol, None, gain, gain, projected))
    return cases
