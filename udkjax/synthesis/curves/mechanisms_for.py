"""Mechanisms with one motor whose pin draws a given curve."""

import time
from typing import Annotated

import numpy as np

from udkjax.annotations import Numbers
from udkjax.argument_types import COUNT, NOT_NEGATIVE, NOT_NEGATIVE_COUNT
from udkjax.progress import ProgressOption, report_progress
from udkjax.requirements import require_choice
from udkjax.scene.arguments import checked
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.synthesis.curves.curve_designs import CurveDesigns, ranked
from udkjax.synthesis.curves.curve_search import FEWEST_BARS, CurveSearch
from udkjax.synthesis.curves.descent import LinkageLimits
from udkjax.synthesis.curves.targets import CHAMFER_POINTS, WantedCurve

# Default of the largest distance of pins from the middle of the curve, in extents of the curve.
DEFAULT_SIZE = 3.0
DEFAULT_TRANSMISSION = float(np.deg2rad(8.0))  # smallest transmission angle by default
SHORTEST_LENGTH = 0.02  # smallest distance of two joints of a dyad's link, in extents of the curve
WORTHWHILE_REDUCTION = 0.03  # fraction by which two more bars must reduce the error to be worth it
SLIDE_FRACTION = 1 / 3  # fraction of dyads that have a slide, if they may
# Two samples of the same curve differ by a quarter of the distance of their points each way; a search ends when the rest is less.
ENOUGH_ERROR = 5e-4
GROWING_FRACTION = 0.9  # fraction of the time after which linkages are only finished and verified


@checked
def mechanisms_for(
    curve: Numbers,
    bars: Annotated[int, COUNT] = 12,
    size: Annotated[float, NOT_NEGATIVE] | None = None,
    results: Annotated[int, COUNT] = 5,
    seconds: Annotated[float, NOT_NEGATIVE] = 60.0,
    seed: Annotated[int, NOT_NEGATIVE_COUNT] = 0,
    part: str = "free",
    transmission: Annotated[float, NOT_NEGATIVE] = DEFAULT_TRANSMISSION,
    rounds: Annotated[int, COUNT] | None = None,
    error: Annotated[float, NOT_NEGATIVE] | None = None,
    geared: bool = True,
    slides: bool = False,
    unit: str = "m",
    progress: ProgressOption = None,
) -> CurveDesigns:
    """Return mechanisms with one motor and a pin that draws a curve; structures and dimensions are found without stored data.

    Random linkages of one to three dyads that turn are matched with the curve by shape, and the best are improved in lanes by
    Levenberg-Marquardt steps towards a small Chamfer distance, which does not depend on the order of strokes. The best ones grow
    by dyads, at first without a change of the curve, and are improved again, up to the number of bars. Every second round begins
    with two cranks of which one turns a whole number of times as fast, by a belt: such linkages draw stars and roses.

    Args:
        curve: points (n, 2) (m), in order; the curve is closed if its ends nearly meet, as if one more of its steps joined them.
        bars: largest number of links, with the ground; a dyad has two.
        size: largest distance (m) of any pin from the middle of the curve, over the whole turn; by default three times the extent
            of the curve.
        results: largest number of designs to return.
        seconds: CPU time of this process, of all its threads, after which the search ends with the best designs so far (s), so
            that other programs on the same machine do not shorten it. It runs until there is a design in any case, some seconds.
        seed: seed of the random linkages. The result follows from the seed and the number of completed stages, which depends on
            the processor's speed; give `rounds`, and enough seconds, for a result that does not.
        part: "free": an open curve is drawn by any part of the turn; "whole": by the whole turn, forth and back.
        transmission: smallest angle (rad) between the two links of a dyad, and between one and the other prolonged, over the
            whole turn.
        rounds: number of rounds after which the search ends.
        error: error, relative to the RMS radius of the curve, with which a design is good enough: the search ends with the first
            one. By default it ends after a round, when the drawn curve is as near as samples of the same curve are to each other.
        geared: whether a second crank, joined to the first by a belt, is allowed.
        slides: whether a third of all dyads has a slide in the place of a pin: a link slides along another one, or on a rail of
            another one or of the ground. By default, all joints are pins: in equal time, they draw letters better.
        unit: unit of lengths of the drawings, such as "mm"; it does not change the mechanisms.
        progress: as for `sweep`: None shows progress after two seconds, False never; or a function of a `Progress`. Ctrl-C ends
            the search with the best designs so far.

    Returns:
        A `CurveDesigns`, ranked by error and simplicity. Every design turns fully, confirmed by `kinematics` at 720 positions.

    Raises:
        ValueError: the curve or a limit is invalid, or the limits contradict each other.
    """
    require_choice("part", part, ("free", "whole"))
    require_choice("unit", unit, tuple(Units.sizes("m")))
    if bars < FEWEST_BARS:
        raise ValueError(f"bars must be at least {FEWEST_BARS}: the ground, a crank and a dyad; not {bars}")
    wanted = WantedCurve(curve, part == "whole")
    search = CurveSearch(
        wanted, curve_limits(wanted, size, float(transmission)), int(bars), int(seed), geared, SLIDE_FRACTION * slides
    )
    begun = time.process_time()
    done = _run(search, float(seconds), rounds, error, begun, progress)
    found = ranked(search.found, wanted, int(results), WORTHWHILE_REDUCTION, unit)
    reason = "" if found else "no linkage turned within the limits: give more seconds, a larger size or a smaller transmission"
    return CurveDesigns(tuple(found), done, search.candidates, time.process_time() - begun, reason)


def _run(
    search: CurveSearch, seconds: float, rounds: int | None, error: float | None, begun: float, progress: ProgressOption
) -> int:
    """Run stages of a search until a design is good enough, or time or rounds are over; return the number of completed rounds.

    `begun` is the CPU time (`time.process_time`) at which the search began; the others are arguments of `mechanisms_for`.
    """
    done, enough = 0, ENOUGH_ERROR + 0.5 * search.wanted.length / CHAMFER_POINTS if error is None else error
    try:
        with report_progress(progress, seconds or None, "mechanisms_for") as report:
            for stage in search.stages():
                if not search.found or (error is not None and search.promises(error)):
                    search.finish()  # from now on there is something to return
                search.until = begun + GROWING_FRACTION * seconds if search.found or done else np.inf
                best = f", error {search.best:.4g}" if np.isfinite(search.best) else ""
                report(min(time.process_time() - begun, seconds), stage + best)
                is_round = stage.endswith("finished")
                done += is_round
                if done == rounds or (search.best <= enough and (is_round or error is not None)):
                    return done
                if time.process_time() > search.until:
                    break
    except KeyboardInterrupt:
        seconds = 0.0  # only the most promising linkages are finished
    search.until = np.inf
    search.finish(begun + seconds)
    return done


def curve_limits(wanted: WantedCurve, size: float | None, transmission: float) -> LinkageLimits:
    """Return the limits of linkages in RMS radii of a curve, from a largest distance (m) and a smallest angle (rad)."""
    if transmission >= np.pi / 2:
        raise ValueError(f"transmission must be an angle below pi / 2 (rad), not {transmission:g}")
    reach = DEFAULT_SIZE * wanted.extent if size is None else float(size)
    needed = wanted.scale * float(np.linalg.norm(wanted.fine, axis=1).max())
    if reach <= needed:
        raise ValueError(f"size must be more than {needed:g} m, the largest distance of the curve from its middle, not {reach:g}")
    return LinkageLimits(float(np.cos(transmission)), reach / wanted.scale, SHORTEST_LENGTH * wanted.extent / wanted.scale)
