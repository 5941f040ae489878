"""The common base of the programs of a scene (scene_programs.py) and of a user-defined system (system_programs.py).

A program computes the `OUTPUTS` that it is asked for, one after another, with all that they depend on computed once.
"""

from abc import abstractmethod
from collections.abc import Collection
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from udkjax.equations.programs.differentiable_programs import DifferentiableProgram
from udkjax.expressions.loops.loop_program import LoopProgram
from udkjax.pinv.rank_policy import RankPolicy

# The outputs of programs. Each is stored in the array that its first word names.
OUTPUTS = {
    # at the state t, q, v
    "psi": "Psi of all rows; zero for rows of a system that restrict velocities alone",
    "psi_dot": "Psi_dot of all rows, and phi",
    "psi_q": "the entries of Psi_q of all rows, in coordinates in which M is diagonal",
    "root": "M^(-1/2) in these coordinates",
    "couplings": "the factors by which these coordinates differ from q; none if M is diagonal, as that of a scene",
    "psi_q of q": "the entries of Psi_q of all rows in the coordinates q themselves",
    "root of q": "M_ii^(-1/2) in the coordinates q themselves",
    "terms": "a_F without friction that depends on the loads of joints, followed by b of all rows",
    "terms with friction": "the same with such friction, by the loads of elimination",
    "energy": "the kinetic and the potential energy (J); the potential of gravity is zero at the origin",
    "pieces": "the index of the smooth piece of each piecewise smooth element, and the loads of edges, of `settled`",
    # by elimination, under the policy in a program that computes accelerations, and else without dependent rows
    "a": "accelerations; if the program reports `unsettled`, friction takes one round of Newton's method for the loads of joints",
    "unsettled": "whether friction needs further rounds, or its loads may be no solution",
    "a further": "accelerations by another round, which begins with `settled`",
    "a settled": "accelerations with the loads of joints with friction that have `settled` before",
    "multipliers": "lambda of all rows, of the accelerations of the program",
    "friction_power": "the power of all friction (W)",
    "q1": "q after a Newton step to Psi = 0",
    "v1": "v after a Newton step to Psi_dot = 0 and phi = 0",
    "dq1": "the tangent part of the change dq",
    "dv1": "the tangent part of the change dv",
    "balance": "a_F as `dv`, its tangent part as `dv1`, and the negative `multipliers` lambda of F = M dv1 + Psi_q^T lambda",
    "safe": "one if all pivots exceed `safe_tol`, or the policy does not check them",
    "distance": "the root of the smallest pivot relative to its diagonal entry: the distance from dependence",
    "independent": "one for each row that is retained, zero for dependent rows",
    "rank": "the number of rows that the last factorization retained, whichever program it was in",
    **{f"{x} refined": f"`{x}` at the state, by a refined solution without dependent rows" for x in ("a", "q1", "v1")},
    # at the end of a Newton step of the same program, with the factors of the state
    "v1 at q1": "v after a Newton step at q1; if the step in q is small, so is that in v, and the change of Psi_q is negligible",
    "psi at q1": "Psi of all rows at q1",
    "a at v1": "accelerations at v1",
    # of a system alone
    "drift": "the change of Psi_dot and phi by dq",
    "dv1 without rows": "M^(-1) dv",
    # of a driven scene at rest, whose driver's value replaces time
    "dq1 by value": "q' by this value, from Psi_q q' = -Psi_t",
    "dv1 by value": "q'' by this value, from Psi_q q'' = gamma at the velocities q'",
}
ACCELERATION_OUTPUTS = frozenset(("a", "a further", "a settled", "a at v1"))  # outputs that follow the policy for pivots
# The arrays that programs return; all others are scratch.
RETURNED_ARRAYS = (
    *("a", "q1", "v1", "dq1", "dv1", "psi", "psi_dot", "terms", "rank", "distance", "safe", "pieces", "root", "energy"),
    *("independent", "multipliers", "unsettled", "settled", "friction_power", "drift"),
)
JACOBIAN_ARRAYS = "psi_q", "couplings"  # the arrays that only programs return which are asked for Psi_q


class Differentiable(Protocol):
    """The differentiable programs of a scene or a system."""

    def of(self, *outputs: str) -> DifferentiableProgram:
        """Return the program of one of "a", "q1" and "v1", or of "q1" and "v1 at q1" of a state on the manifold."""
        ...


class RunPrograms:
    """Programs over arrays of numbers: they compute `OUTPUTS` from constants, t, q, v, dq and dv.

    The `policy` for small pivots concerns the accelerations; corrections leave out rows whose pivots do not exceed `drop_tol`.
    """

    # Arrays with which programs of friction begin: the solution `settled` of their linear system, and the share of friction.
    BEGINS: ClassVar[tuple[str, ...]] = ("settled", "friction_share")
    policy: RankPolicy
    coordinate_count: int
    row_count: int
    couples: bool = False
    """True if M is not diagonal: `spread` and `gather` then change coordinates (native/pseudoinverses/weighted_rows.py)."""
    owner: str = "the scene"
    """The object whose functions the programs contain, for messages."""
    excess: str = ""
    """The reason why the programs are too long for machine code; empty if they are not."""
    has_mobility: bool = False
    """True if M is not an input, but there is the output "dv1 without rows"."""
    has_loops: bool = True
    """True if the programs can also be written as loops, which are compiled sooner."""
    rubs: bool = False
    """True if friction depends on the loads of joints, which may then be `unsettled`."""
    weighs_rows: bool = False
    """True if redundant rows share the loads of joints with friction: numbers are then the weights of rows, not their marks."""
    shares_by_marks: bool = False
    """True if redundant rows share such loads, but marks tell which these are, and `with_shared_rows` has the programs."""
    STAGES: ClassVar[int] = 8
    """Shares by which friction grows where its loads do not settle, down to shares of a share where these are too long; fewer may
    do, but most mechanisms need none."""
    rolling_rows: tuple[int, ...] = ()
    """The rows of a scene that restrict velocities alone: their Psi is zero."""
    is_linear: bool = True
    """True if constraints on velocities are linear in them."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...  # attributes that scenes and systems define in their own ways

    @cached_property
    def _programs(self) -> dict[tuple[str, ...], LoopProgram]:
        """The programs that have been asked for, by their outputs."""
        return {}

    def of(self, *outputs: str) -> LoopProgram:
        """Return the program that computes some `OUTPUTS`, in this order; it is written on the first request.

        Scenes have arrays for four linear systems in one program, which limits the outputs that a program may combine.
        """
        if outputs not in self._programs:
            self._programs[outputs] = self._write(outputs)
        return self._programs[outputs]

    @abstractmethod
    def _write(self, outputs: tuple[str, ...]) -> LoopProgram:
        """Write the program that computes some outputs."""

    @classmethod
    def goes_on(cls, outputs: Collection[str]) -> bool:
        """Return whether a program with these outputs reads the arrays `BEGINS`, which are then inputs."""
        return not {"a further", "a settled", "pieces"}.isdisjoint(outputs)

    def drops(self, outputs: Collection[str]) -> bool:
        """Return whether a program with these outputs leaves out rows with small pivots."""
        return self.policy.drops or ACCELERATION_OUTPUTS.isdisjoint(outputs)

    @property
    def marks(self) -> slice:
        """The places of the marks of rows among the numbers, if there are any: before the two thresholds of pivots."""
        return slice(self.number_count - 2 - self.row_count, self.number_count - 2)

    def with_shared_rows(self, rows: tuple[int, ...]) -> "RunPrograms":
        """Return programs with the same inputs in which `rows` are redundant and share loads; weights take the place of marks."""
        raise NotImplementedError(type(self).__name__)

    @property
    def position_rows(self) -> int:
        """The number of rows that restrict positions, which come first; by default all."""
        return self.row_count

    @property
    def term_count(self) -> int:
        """The number of values of the output "terms"."""
        return self.coordinate_count + self.row_count
