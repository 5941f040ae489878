"""The common base of the programs of a scene (scene_programs.py) and of a user-defined system (system_programs.py)."""

from typing import TYPE_CHECKING, Any, ClassVar

from udkjax.pinv.rank_policy import RankPolicy

# The arrays that programs return; all others are scratch.
RESULTS = (
    *("a", "q1", "v1", "dq1", "dv1", "psi", "psi_dot", "terms", "rank", "distance", "safe", "pieces", "root", "energy"),
    *("independent", "multipliers", "unsettled", "settled", "friction_power", "drift"),
)


class RunPrograms:
    """Programs over arrays of numbers: they compute `RESULTS` from constants, t, q, v, dq and dv.

    `safe` is one if all pivots exceed `safe_tol`; `distance`, the root of the smallest pivot relative to its diagonal entry, is
    the distance from dependence. The docstring of each program names its results. The `policy` for small pivots concerns the
    accelerations; corrections leave out the rows whose pivots do not exceed `drop_tol`.
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
    """True if there is a program `mobility`, v1 = M^(-1) dv: M is not an input."""
    has_loops: bool = True
    """True if the programs can also be written as loops, which are compiled sooner."""
    rubs: bool = False
    """True if friction depends on the loads of joints: `accelerations` then report that these are `unsettled`."""
    weighs_rows: bool = False
    """True if redundant rows share the loads of joints with friction: numbers are then the weights of rows, not their marks."""
    shares_by_marks: bool = False
    """True if redundant rows share such loads, but marks tell which these are, and `with_shared_rows` has the programs."""
    FURTHER: ClassVar[str] = "accelerations_further"
    """The program that goes on from `settled`."""
    STAGES: ClassVar[int] = 8
    """Shares by which friction grows where its loads do not settle, down to shares of a share where these are too long; fewer may
    do, but most mechanisms need none."""
    rolling_rows: tuple[int, ...] = ()
    """The rows of a scene that restrict velocities alone: their Psi is zero."""
    is_linear: bool = True
    """True if constraints on velocities are linear in them."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...  # the programs, by their names

    @property
    def marks(self) -> slice:
        """The places of the marks of rows, if there are any, among the numbers: before the two thresholds of pivots."""
        return slice(self.number_count - 2 - self.row_count, self.number_count - 2)

    def with_shared_rows(self, rows: tuple[int, ...]) -> "RunPrograms":
        """Return programs with the same inputs in which these rows are redundant and share loads, by weights instead of marks."""
        raise NotImplementedError(type(self).__name__)

    @property
    def settled_accelerations(self) -> Any:
        """The program `accelerations` with friction that is settled, without reports."""
        return self.accelerations

    @property
    def rows_of_positions(self) -> Any:
        """The program of Psi_q, root, M_ii^(-1/2), and psi, in the coordinates themselves, where `couples` makes others."""
        return self.dense_newton_q

    @property
    def rows_of_velocities(self) -> Any:
        """The same of A, with Psi_dot and phi, stored as psi."""
        return self.dense_newton_v

    @property
    def position_rows(self) -> int:
        """The number of rows that restrict positions, which come first; by default all."""
        return self.row_count

    @property
    def term_count(self) -> int:
        """The number of values that `equation_terms` returns."""
        return self.coordinate_count + self.row_count
