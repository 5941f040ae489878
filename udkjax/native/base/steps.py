"""The numbers that steps are chosen by, for machine code and whatever steps as it does."""

from typing import NamedTuple


class StepFactors(NamedTuple):
    """The next step over the last one: `safety` times one whose error would be the tolerance, between `shrink` and `grow`.

    These are the usual bounds. With a safety of 0.9 every tenth step of a typical run is rejected, and most runs take 4 to 15 %
    more at equal error. A step that is tried again for the sake of a pivot is as much shorter.
    """

    safety: float = 0.8
    shrink: float = 0.2
    grow: float = 10.0


FACTORS = StepFactors()

# Of the step before a breakpoint: the first behind it. Its outputs have states on one side alone, and so larger errors: with
# SAFETY in its place rates across the knots of a cam are off by 34 times the tolerance instead of ten.
RESTART_FACTOR = 0.5

# Steps near singular configurations. Distances are the smallest pivot of D D^T relative to its diagonal, as a root.
RETRIES = 3  # of a step that meets a pivot which elimination must not trust, before the fallback takes it
# Elimination trusts no pivot that is closer than 1e-3 (`BRANCH_TOL`); from here on a step has no stage where it does.
NEAREST_STAGE = 1.5e-3
# Rounding errors of accelerations are about a unit of rounding over the third power of the distance, in the scene's own units;
# their share of a step's velocity must be less than the tolerance.
ROUNDING_GROWTH = 3e-14
# Of a step: a configuration that is expected by then lies behind its end, though it is expected a little too early, by up to
# a tenth of a step. Where it is far away, it may be expected by three tenths too early, and just be ahead of the end: less than
# this much of the distance that the end should have by then.
SURE, EXPECTED = 0.85, 0.3

# Breakpoints: a step ends two units of rounding of the time before one, and the next begins a unit behind it. Those that are
# nearer to one another than the smallest step count as one.
SMALLEST_STEP = 100.0  # units of rounding of the end time: below it time does not advance
UNIT = 1 / SMALLEST_STEP  # of the smallest step
ENDS_BEFORE, BEGINS_BEHIND = 2 * UNIT, UNIT
GAP = ENDS_BEFORE + BEGINS_BEHIND

# Pieces of the state.
EDGE = 1e-7  # of a step: how long the one across is. Another piece affects a step by the square of the part that is there
# Of a step: where a piece ends so close to either of its ends, these tell when to rounding.
NEAR_END = 0.01
# A step that is taken again ends a little beyond the piece; or, once it is known when that ends, just before; or it leads across.
AIM_BEYOND, AIM_BEFORE, AIM_ACROSS = range(3)
HALVINGS = 40
TRIES = 8  # in a row to end a step where a piece does: a mechanism at rest there may be in either, by rounding

POINTS = 4  # states that an interpolating polynomial goes through: with three, velocities between steps are worse than at steps
# Of a step: a last one that were shorter takes half of it. Outputs of the first step wait for the second, and the polynomial
# through two points that lie so close beside it takes rounding errors for velocities: by 1e-4 m/s where the last is 1 / 300.
SHORTEST_LAST = 0.25
STRETCH = 12.0  # ratio of the last step to those before, at most: steps grow tenfold


class Status:
    """The status of a run.

    `NOT_FINITE`: its step became too small because of a number that is not finite. `LOST`: it left the constraint manifold. Of
    runs that watch conditions: `CROSSED`: it is at the time at which one crosses zero. `UNRESOLVED`: one may.
    """

    RUNNING, DONE, STEP_LIMIT, STEP_TOO_SMALL, NOT_FINITE, LOST, CROSSED, UNRESOLVED = range(8)


# Each row of Psi over its scale, after a step whose end was projected, which leaves some 1e-12: a row so far open is one that no
# position near it closes, as where a driver asks for more than a linkage reaches. Behind that there is no motion to follow.
LOST_TOL = 1e-2

LOOK_AHEAD = 1e-6  # of the span: how far beyond the end of a run that stopped one looks for what is not finite

# Weight of the error component normal to the manifold, which projection removes: it lasts only by its effect within the step.
# Close to singular configurations it is the stages' distance from the manifold over a small singular value: for its sake alone,
# steps were up to six times as many at tolerances of 1e-11. A hundredth keeps some of these; with none of it, runs that cross are
# less exact than their tolerance says.
NORMAL_ERROR_WEIGHT = 1e-3

# A pivot, relative to its row's diagonal entry of D D^T: below the first is rounding; rows of outputs whose pivots are below the
# second, the root of a unit of rounding, stay as they were interpolated: rounding errors would turn their velocities.
ROUNDING_PIVOT, OUTPUT_PIVOT_TOL = 1e-14, 1e-8

OUTPUT_STEPS = 7  # of Newton's method to an output: where two branches of the manifold meet, it halves the distance in each
NEWTON_STEPS = 3  # in a projection, at most: the last of which usually finds nothing to do
# Of the characteristic length, and rad: a Newton step that moves q by less leaves rounding errors, since it converges
# quadratically.
NEWTON_TOL = 1e-8
# Tolerance of an output after its projection, each row over its scale: Newton's last step leaves far less, and
# interpolation of a row that is not projected far more. Beyond it, the output is closed on all rows.
OPEN_OUTPUT = 1e-9
# An output that lies nearer to the manifold takes one Newton step in q and v alike: its residual is the square of that.
SINGLE_STEP_TOL = 1e-7
