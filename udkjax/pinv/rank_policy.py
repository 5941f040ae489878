"""The policy for small pivots in elimination: the one decision near singular configurations.

D D^T = L diag(p) L^T. The pivot p_i, relative to its row's diagonal entry of D D^T, is the square of the sine of the angle
between row i and the rows eliminated before it: a rounding error if the row depends on them, and small near a singular
configuration. Elimination amplifies rounding errors by 1 / p_i. The pivot is compared with two thresholds, which may be traced:

    drop_tol    at or below it the row counts as dependent and is left out, with zero for 1 / p_i;
    safe_tol    at or below it the result cannot be trusted, which the last output of the program, `safe`, reports.

The policy is static: it decides which of the two thresholds a program uses.
"""

from enum import Enum

from udkjax.pinv.auto import Auto
from udkjax.pinv.rule import Pseudoinverse


class RankPolicy(Enum):
    """Treatment of pivots below a threshold."""

    REFUSE = "refuse"
    """Use all pivots, and report whether all exceed `safe_tol`. A step that is not safe is rejected, and machine code repeats it
    by a rank-revealing method. This is the fastest policy, because no operation waits for a comparison."""

    DROP = "drop"
    """Leave out the rows whose pivots do not exceed `drop_tol`, and use the result without a check: the pseudoinverse by
    elimination alone."""

    FALL_BACK = "fall back"
    """Leave out the rows whose pivots do not exceed `drop_tol`, and report whether all exceed `safe_tol`. Derivatives use this
    policy: elimination then agrees with the rank-revealing method that repeats rejected steps."""

    @classmethod
    def of(cls, method: Pseudoinverse) -> "RankPolicy":
        """Return the policy of a method: small pivots are refused if it has a rank-revealing fallback, else dropped."""
        return cls.REFUSE if isinstance(method, Auto) else cls.DROP

    @property
    def drops(self) -> bool:
        """True if dependent rows are left out."""
        return self is not RankPolicy.REFUSE

    @property
    def reports(self) -> bool:
        """True if the output `safe` of programs tells whether their results can be trusted."""
        return self is not RankPolicy.DROP
