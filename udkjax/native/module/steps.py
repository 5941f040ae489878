"""The parameters of step control, for machine code and for other integrators with the same steps."""

from typing import NamedTuple


class StepFactors(NamedTuple):
    """Factors of step control: the next step is `safety` times the step whose error would equal the tolerance.

    Its ratio to the previous step is between `shrink` and `grow`. These are the usual bounds. With a safety of 0.9 a tenth of the
    steps of a typical run is rejected, and most runs take 4 to 15 % more steps for the same error. A step that is repeated
    because of a small pivot is shortened by `safety`.
    """

    safety: float = 0.8
    shrink: float = 0.2
    grow: float = 10.0


FACTORS = StepFactors()

# Length of the first step after a breakpoint, relative to the step before it. Outputs in this step are interpolated from states
# on one side only and have larger errors: with `safety` instead of 0.5, the error of rates across the knots of a cam is 34 times
# the tolerance instead of ten times.
RESTART_FACTOR = 0.5

# Steps near singular configurations. The distance is the root of the smallest pivot of D D^T relative to its diagonal entry.
PIVOT_RETRIES = 3  # attempts to avoid a pivot that is too small for elimination, before the fallback takes the step
# Smallest distance at the stages of a step: elimination is not used below 1e-3 (`BRANCH_TOL`).
NEAREST_STAGE = 1.5e-3
# Distance beyond which no step is planned around a singular configuration: rows that meet at a larger angle are well conditioned.
PLANNING_DISTANCE = 0.1
# The rounding error of accelerations, in the scene's own units, is this number divided by the cube of the distance. Its
# contribution to the velocity in a step must be less than the tolerance.
ROUNDING_GROWTH = 3e-14
# The rounding error of a velocity across, in the same units, is this number divided by the square of the distance: a few eps. A
# larger one lets errors of the method pass: with 1e-14, an overconstrained chain in space loses 15,000 tolerances of its energy.
ROUNDING_ACROSS = 1e-15
# If a singular configuration is predicted before the fraction SURE_FRACTION of a step, the step certainly passes it:
# predictions are too early by at most a tenth of a step. From far away they may be too early by three tenths, and the
# configuration may still be ahead; then the distance at the end of the step is less than EXPECTED_RATIO times the extrapolated
# distance.
SURE_FRACTION, EXPECTED_RATIO = 0.85, 0.3

# Further rounds of Newton's method for the loads of joints with friction. Five are needed at 0.99 of the jamming coefficients.
SETTLING_ROUNDS = 20
STAGE_ROUNDS = 8  # in a stage of growing friction, which is repeated with less of it if they do not suffice

# Breakpoints: a step ends two units of rounding before the time of a breakpoint, and the next begins one unit after it.
# Breakpoints closer to one another than the smallest step count as one.
SMALLEST_STEP = 100.0  # in units of rounding of the end time; time would not advance by shorter steps
ROUNDING_UNIT = 1 / SMALLEST_STEP  # a unit of rounding, as a fraction of the smallest step
ENDS_BEFORE, BEGINS_BEHIND = 2 * ROUNDING_UNIT, ROUNDING_UNIT
BREAK_GAP = ENDS_BEFORE + BEGINS_BEHIND

# Pieces of the state.
EDGE_STEP = 1e-7  # length of the step across the end of a piece, as a fraction of a step; its error is of the order of its square
# Fraction of a step. An end of a piece closer than this to an end of the step is located exactly, from the state at that end.
NEAR_END_FRACTION = 0.01
# A repeated step ends slightly beyond the end of a piece. Once the end of the piece has been located, a step ends just before it,
# and the next step crosses it.
AIM_BEYOND, AIM_BEFORE, AIM_ACROSS = range(3)
# A step crosses the end of a piece of an element, or a state where the load of a joint with friction changes its sign.
ACROSS_PIECE, ACROSS_EDGE = 1.0, 2.0
PIECE_HALVINGS = 40  # at most; they locate the end of a piece within a step
# Share of the tolerance of velocities. A load that would change them less in a step may be a rounding error of random sign: the
# slide has no load.
NEGLIGIBLE_LOAD = 0.01
# Share of the load of an edge at the start of a step. If it is smaller at the end, stages near the end may be beyond its zero.
NEAR_ZERO_SHARE = 0.2
# Successive attempts to end a step at the end of a piece; for a state at rest there, rounding decides between pieces.
PIECE_TRIES = 8

# Stages of implicit methods. A correction below STAGE_TOL of the tolerance of a step is the last. The rate of convergence, the
# ratio of a correction to the one before, also counts for later stages; it fades by the factor RATE_FADING with each correction.
STAGE_TOL, RATE_FADING = 1e-3, 0.3
# Where the rate exceeds SLOW_RATE, the matrix is renewed: at most RENEWALS times in a stage, and during the next EAGER_STEPS
# steps at the beginning of each stage. If the rate exceeds DIVERGING_RATE nevertheless, or a correction is too large after
# STAGE_ITERATIONS, the step is repeated with STAGE_SHRINK of its length.
SLOW_RATE, RENEWALS, EAGER_STEPS, DIVERGING_RATE, STAGE_ITERATIONS, STAGE_SHRINK = 0.3, 3.0, 10.0, 1.0, 10, 0.4

# Change to an implicit method. The largest rate of the equations is measured in one of MEASURING_PERIOD attempts: measured in
# each, it would take a tenth of the time of small scenes. Where the length of an explicit step times this rate exceeds
# STIFF_LIMIT, stability may limit it: Dopri8 is stable up to 3.7 for undamped oscillations, and up to STABILITY_LIMIT for others,
# and the controller takes four fifths of that. Both are properties of its tableau, and ten times as much would never be reached.
# But steps as long may be due to a visible vibration, which every method must follow. Therefore the next attempt is an implicit
# step, PAYING_MARGIN times as long as it has to be to pay. If its error is below the tolerance, the run goes on implicitly, until
# UNPAID_STEPS steps in succession do not pay. After each failure of either kind the run waits twice as many attempts until the
# next measurement.
STIFF_LIMIT, STABILITY_LIMIT, MEASURING_PERIOD, PAYING_MARGIN, UNPAID_STEPS = 3.0, 5.2, 32.0, 2.0, 25.0
# The cost of an implicit step in evaluations of accelerations: CORRECTION_COST for the corrections of each stage, and SLOPE_COST
# for the slopes along each of n directions, or SLOPE_COST_IN_LANES where several directions share a register.
CORRECTION_COST, SLOPE_COST, SLOPE_COST_IN_LANES = 3.0, 2.0, 0.5

# States that the interpolating polynomial passes through; with three, velocities between steps are less accurate.
NODE_COUNT = 4
# Fraction of a step. If less than this would remain for the last step, the remaining time is halved instead. Outputs of the
# first step are interpolated after the second, and interpolation through two close points amplifies rounding errors: to 1e-4 m/s
# if the last step is 1/300 of the step before it.
SHORTEST_LAST = 0.25
# Largest ratio of the last step to those before, and of a step to the next attempt: steps grow at most tenfold.
LARGEST_STRETCH = 12.0
# Length of a step, in T, below which the change of a position follows from velocities and accelerations at its ends: the error is
# of the fifth order, while the rounding errors of the positions would add as many units of rounding to a velocity, divided by it.
SHORT_STEP = 1e-6


class Status:
    """The status of a run.

    `NOT_FINITE`: the step became too small because of a non-finite number. `LOST`: the run left the constraint manifold.
    `SINGULAR`: a run that is not projected is too far from the manifold for the singular configuration that it is near.
    `SPURIOUS_RANK`: dependent rows were treated as independent. `MISSING_RANK`: independent rows were left out as dependent, and
    the motion violates them.
    Runs that watch conditions also end as `CROSSED`, at a zero crossing, or `UNRESOLVED`, where a crossing is possible.
    `INTERRUPTED`: by Ctrl-C.
    """

    RUNNING, DONE, STEP_LIMIT, STEP_TOO_SMALL, NOT_FINITE, LOST, SINGULAR, SPURIOUS_RANK, MISSING_RANK = range(9)
    CROSSED, UNRESOLVED, INTERRUPTED = range(9, 12)


# Bounds of Psi after the projection of a step, each row over its scale. Projection usually leaves 1e-12. Where rows become
# dependent, it leaves a fraction of the error before it, which is some tolerances, and rows with small pivots are left out.
# Beyond CLOSED_TOL tolerances, the threshold of pivots and `drift_tol`, or beyond LOST_TOL whatever these are, no position
# nearby is closed, for instance because a driver exceeds the range of a linkage. The nearest positions change smoothly with
# time: a run would follow them by thousands of steps.
CLOSED_TOL, LOST_TOL = 100.0, 1e-2

LOOK_AHEAD = 1e-6  # fraction of the span after the end of a stopped run that is searched for non-finite numbers

# Weight of the error component normal to the manifold. Projection removes this component, and only its effect within the step
# remains. Near singular configurations the component is the stages' distance from the manifold divided by a small singular value:
# with weight one, runs took up to six times as many steps at tolerances of 1e-11. With weight 1e-2 some of these extra steps
# remain; with weight zero, runs across singular configurations are less accurate than their tolerance.
NORMAL_ERROR_WEIGHT = 1e-3

# Thresholds of a pivot, relative to its diagonal entry of D D^T. A pivot below the first is a rounding error. Rows of outputs
# with pivots below the second, the root of a unit of rounding, are not projected: rounding errors would dominate their
# velocities.
ROUNDING_PIVOT, OUTPUT_PIVOT_TOL = 1e-14, 1e-8

OUTPUT_STEPS = 7  # Newton steps for an output: where two branches of the manifold meet, a step only halves the distance
NEWTON_STEPS = 3  # maximum number of Newton steps in a projection; the last usually changes nothing
# A Newton step that moves q by less, in characteristic lengths or rad, is the last: the method converges quadratically.
NEWTON_TOL = 1e-8
# Tolerance of Psi at an output after its projection, each row over its scale: the last Newton step leaves much
# less, and interpolation without projection much more. If it is exceeded, the output is closed on all rows.
OPEN_OUTPUT = 1e-9
# Outputs nearer to the manifold need only one Newton step in q and v, which leaves a residual of the order of the distance
# squared.
SINGLE_STEP_TOL = 1e-7
