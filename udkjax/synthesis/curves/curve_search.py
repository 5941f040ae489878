"""The search for linkages that draw a curve: random ones, matched, improved in lanes, and grown by dyads, in rounds."""

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from udkjax.synthesis.curves.descent import Descended, LinkageLimits, Task, descend, sampling
from udkjax.synthesis.curves.dyads import (
    BASE_LINKS,
    DYAD_NUMBERS,
    GEARED_CRANK,
    HEAD_NUMBERS,
    SPAN_INDEX,
    TAIL_NUMBERS,
    Topology,
    positions,
)
from udkjax.synthesis.curves.matching import find_starts
from udkjax.synthesis.curves.random_linkages import grown
from udkjax.synthesis.curves.targets import WantedCurve
from udkjax.threads import thread_count

FEWEST_BARS = 4
BATCH_LINKAGES = 16  # linkages of a batch: their numbers stay in the cache
RANDOM_LINKAGES = 6000  # random linkages of a stage
START_DYADS = 3  # most dyads of random linkages; with more, few random curves resemble the target
DYAD_TRIES, KEPT_CHILDREN = 200, 10  # random dyads for each linkage that grows, and how many of them are improved
BEAM_WIDTH, FAMILY_SIZE = 10, 3  # linkages of each number of dyads that are kept and grow, and most of them from the same start
# blur (RMS radii), weight of violations, steps and linkages left of each part of a stage
OF_STARTS = ((0.2, 2.0, 10, 48), (0.1, 5.0, 15, 24), (0.05, 20.0, 25, 8))
OF_GROWTH = ((0.05, 5.0, 12, 40), (0.03, 10.0, 20, 20), (0.02, 30.0, 30, 10))
OF_FINISH = ((0.01, 100.0, 20), (0.004, 300.0, 20))
FINISHED_PER_ROUND = 3  # linkages of each number of dyads that are finished after a round
CLOSE_TO = 1e-3  # losses that differ by less, relative, in the same structure are those of the same linkage
LIMIT_SLACK = 1e-3  # largest violation at the end of a descent, which aims at limits that are tighter by twice as much
CHECKED_ANGLES = 1440  # angles of a turn at which limits are verified


class Kept(NamedTuple):
    """Linkages of the same number of bars: numbers x, structures, losses, and the index of the start from which each grew."""

    x: np.ndarray
    topology: Topology
    loss: np.ndarray
    family: np.ndarray

    def take(self, which: np.ndarray) -> "Kept":
        """Return the linkages that `which`, a mask or indices, selects."""
        return Kept(self.x[which], self.topology.take(which), self.loss[which], self.family[which])

    def with_others(self, other: "Kept | None") -> "Kept":
        """Return these linkages together with others, if there are any."""
        if other is None:
            return self
        joined = [np.concatenate(pair) for pair in zip(self.topology, other.topology, strict=True)]
        rest = [np.concatenate([getattr(self, n), getattr(other, n)]) for n in ("x", "loss", "family")]
        return Kept(rest[0], Topology(*joined), rest[1], rest[2])

    def best(self, count: int, family: int) -> "Kept":
        """Return the best different linkages, at most `count`, and at most `family` of them from the same start."""
        chosen: list[int] = []
        for k in np.argsort(self.loss, kind="stable"):
            if not np.isfinite(self.loss[k]) or len(chosen) == count:
                break
            same = [j for j in chosen if self.family[j] == self.family[k]]
            if len(same) < family and not any(abs(self.loss[j] - self.loss[k]) <= CLOSE_TO * self.loss[k] for j in same):
                chosen.append(int(k))
        return self.take(np.array(chosen, int))


class FoundLinkage(NamedTuple):
    """A linkage within the limits over the whole turn.

    Attributes:
        error: its Chamfer distance.
        x: its numbers.
        topology: its structure.
        sine: smallest sine of an angle between the links of a dyad.
        size: largest distance of a pin from the middle of the curve.
    """

    error: float
    x: np.ndarray
    topology: Topology
    sine: float
    size: float

    @property
    def bars(self) -> int:
        """The number of links, with the ground, that the drawing pin needs."""
        return FEWEST_BARS + 2 * (self.topology.dyads - 1) + int(self.topology.ratio[0] != 0)


class CurveSearch:
    """A search in rounds, each of several stages. Results follow from the seed and the number of stages, not from time.

    Args:
        wanted: the wanted curve.
        limits: the limits.
        bars: the largest number of links, with the ground.
        seed: seed of all random numbers.
        geared: whether every second round begins with two geared cranks, if there are enough bars.
        slides: fraction of random dyads that have a slide.
    """

    def __init__(
        self, wanted: WantedCurve, limits: LinkageLimits, bars: int, seed: int, geared: bool = True, slides: float = 0.0
    ):
        self.wanted, self.limits, self.bars = wanted, limits, bars
        self.geared, self.slides = geared and bars > FEWEST_BARS, slides
        self.seed, self.families, self.candidates = seed, 0, 0
        inner = limits._replace(cosine=limits.cosine - 2 * LIMIT_SLACK, size=limits.size * (1.0 - 2 * LIMIT_SLACK))
        self.coarse = Task(wanted.target(96), sampling(64, 32, wanted.is_whole), inner)
        self.exact = Task(wanted.target(240), sampling(192, 64, wanted.is_whole), inner)
        self.beams: dict[int, Kept] = {}  # of all rounds, by the number of bars; an odd one if there is a second crank
        self.fresh: dict[int, Kept] = {}  # of this round
        self.finished: set[float] = set()  # losses of linkages that are finished
        self.found: dict[int, list[FoundLinkage]] = {}
        self.turned: set[int] = set()  # numbers of bars of which a finished linkage was within the limits
        self.threads = ThreadPoolExecutor(thread_count())
        self.until = np.inf  # CPU time (`time.process_time`) after which descents end early

    def stages(self) -> Iterator[str]:
        """Run the search without end, and yield a description of each stage after it.

        A round begins anew, since what grows best is not known from its start; then the best linkages of all rounds grow again.
        """
        done = 0
        while True:
            rng = np.random.default_rng((self.seed, done))
            self.fresh = fresh = {}
            fewest = FEWEST_BARS + (done % 2 if self.geared else 0)
            for bars in range(fewest, min(fewest + 2 * START_DYADS, self.bars + 1), 2):
                self._start(fresh, bars, rng)
                yield f"round {done + 1}: random linkages of {bars} bars"
            for beams in (fresh, self.beams)[: 2 if done else 1]:
                for bars in range(fewest, self.bars - 1, 2):
                    self._grow(beams, bars, rng)
                    yield f"round {done + 1}: linkages of {bars + 2} bars"
                self._merge()
            self.finish()
            done += 1
            yield f"round {done}: finished"

    @property
    def best(self) -> float:
        """The smallest Chamfer distance so far; infinite before the first linkage is finished."""
        return min((one.error for found in self.found.values() for one in found), default=np.inf)

    def promises(self, error: float) -> bool:
        """Return True if an unfinished linkage of this round may reach an error when finished: its loss is at most twice that."""
        blur = OF_GROWTH[-1][0]
        losses = [loss for kept in self.fresh.values() for loss in kept.loss if loss not in self.finished]
        return min(losses, default=np.inf) <= 2.0 * (np.hypot(error, blur) - blur)

    def finish(self, until: float = np.inf) -> None:
        """Improve the best linkages of each number of bars by last, exact steps, and store those that turn within the limits.

        If none of the best turns, the next ones are tried. Linkages of an incomplete round are included.

        Args:
            until: CPU time (`time.process_time`) after which only the most promising number of bars is tried, or further ones
                until a linkage is found.
        """
        self._merge()
        order = sorted((n for n, kept in self.beams.items() if len(kept.x)), key=lambda n: self.beams[n].loss[0])
        for k, bars in enumerate(order):
            while (k == 0 or time.process_time() < until or not self.found) and self._finish(bars):
                pass

    def _start(self, beams: dict[int, Kept], bars: int, rng: np.random.Generator) -> None:
        dyads, geared = divmod(bars - 2, 2)
        x, topology = find_starts(
            self.wanted, self.limits, dyads, RANDOM_LINKAGES, 2 * OF_STARTS[0][3], rng, bool(geared), self.slides
        )
        family = self.families + np.arange(len(x))
        self.families += len(x)
        if len(x):
            self._keep(beams, bars, self._improve(Kept(x, topology, np.zeros(len(x)), family), OF_STARTS))

    def _grow(self, beams: dict[int, Kept], bars: int, rng: np.random.Generator) -> None:
        if bars not in beams or not len(beams[bars].x):
            return
        parents = beams[bars]
        x, topology = grown(
            (parents.x, parents.topology), self.coarse.target, self.coarse.sample, DYAD_TRIES, KEPT_CHILDREN, rng, self.slides
        )
        children = Kept(x, topology, np.zeros(len(x)), np.repeat(parents.family, KEPT_CHILDREN))
        self._keep(beams, bars + 2, self._improve(children, OF_GROWTH))

    def _keep(self, beams: dict[int, Kept], bars: int, kept: Kept) -> None:
        beams[bars] = kept.with_others(beams.get(bars)).best(BEAM_WIDTH, FAMILY_SIZE)

    def _merge(self) -> None:
        """Add the linkages of this round to those of all rounds."""
        for bars, kept in self.fresh.items():
            self._keep(self.beams, bars, kept)

    def _improve(self, kept: Kept, parts: tuple[tuple[float, float, int, int], ...]) -> Kept:
        for part in parts:
            blur, weight, steps, left = part
            after = self._descend(kept.x, kept.topology, self.coarse.weighed(weight), blur, steps)
            loss = np.where(after.excess < LIMIT_SLACK, after.chamfer, np.inf if part == parts[-1] else after.loss)
            kept = Kept(after.x, kept.topology, loss, kept.family)
            kept = kept.take(np.argsort(loss, kind="stable")[:left])
        return kept

    def _descend(self, x: np.ndarray, topology: Topology, task: Task, blur: float, steps: int) -> Descended:
        """Return the results of `descend` for linkages, in batches on all threads."""
        self.candidates += len(x)
        batches = [slice(k, k + BATCH_LINKAGES) for k in range(0, len(x), BATCH_LINKAGES)]
        given = task, blur, steps, self.until
        results = list(self.threads.map(lambda part: descend(x[part], topology.take(part), *given), batches))
        return Descended(*(np.concatenate(a) for a in zip(*results, strict=True)))

    def _finish(self, bars: int) -> bool:
        """Finish the best unfinished linkages of a number of bars; return True if there may be more and none has turned."""
        kept = self.beams[bars]
        new = [
            k
            for k, loss in enumerate(kept.loss)
            if loss not in self.finished and (k < FINISHED_PER_ROUND or bars not in self.turned)
        ]
        if not new:
            return False
        new = new[:FINISHED_PER_ROUND]
        kept = kept.take(np.array(new))
        x = kept.x
        for blur, weight, steps in OF_FINISH:
            x = self._descend(x, kept.topology, self.exact.weighed(weight), blur, steps).x
        if time.process_time() < self.until:  # otherwise they are to be finished again
            self.finished.update(kept.loss)
        for k in range(len(x)):
            one = self.verified(*without_idle_dyads(x[k], kept.topology.take(slice(k, k + 1))))
            if one is not None:
                self.turned.add(bars)
                self.found[one.bars] = sorted([*self.found.get(one.bars, []), one], key=lambda f: f.error)[:BEAM_WIDTH]
        return bars not in self.turned

    def verified(self, x: np.ndarray, topology: Topology) -> FoundLinkage | None:
        """Return the linkage with its error if it is within the limits over the whole turn, else None."""
        at = positions(x[None], topology, np.arange(CHECKED_ANGLES)[None] * (2 * np.pi / CHECKED_ANGLES), 0.0)
        joints = np.concatenate(
            [at.origins[1:] if topology.ratio[0] else np.delete(at.origins[1:], GEARED_CRANK - 1, 0), at.ends, at.pin[None]]
        )
        cosine, size = float(np.abs(at.cosines).max()), float(np.abs(joints).max())
        if not (cosine <= self.limits.cosine and size <= self.limits.size):
            return None
        error = self.wanted.error(drawn(x, topology, self.wanted.is_whole))
        return FoundLinkage(error, x, topology, np.sqrt(1.0 - cosine**2), size)


def drawn(x: np.ndarray, topology: Topology, is_whole: bool, count: int = 2001) -> np.ndarray:
    """Return the drawn curve of one linkage by complex points; of a whole turn, the last one is the first."""
    share = np.linspace(0.0, 1.0, count)
    return positions(x[None], topology, x[None, SPAN_INDEX : SPAN_INDEX + 1] * share).pin[0]


def without_idle_dyads(x: np.ndarray, topology: Topology) -> tuple[np.ndarray, Topology]:
    """Return a linkage without the dyads that do not move the drawing pin."""
    first, second = topology.first[0], topology.second[0]
    needed = {topology.dyads - 1}
    for d in range(topology.dyads - 1, -1, -1):
        if d in needed:
            needed |= {(link - BASE_LINKS) // 2 for link in (int(first[d]), int(second[d])) if link >= BASE_LINKS}
    dyads = sorted(needed)
    number = np.arange(BASE_LINKS + 2 * topology.dyads)
    for new, old in enumerate(dyads):
        number[BASE_LINKS + 2 * old : BASE_LINKS + 2 * old + 2] = BASE_LINKS + 2 * new, BASE_LINKS + 2 * new + 1
    parts = [
        x[:HEAD_NUMBERS],
        *(x[HEAD_NUMBERS + DYAD_NUMBERS * d : HEAD_NUMBERS + DYAD_NUMBERS * (d + 1)] for d in dyads),
        x[-TAIL_NUMBERS:],
    ]
    first, second = number[topology.first[:, dyads]], number[topology.second[:, dyads]]
    ratio = topology.ratio * ((first == GEARED_CRANK) | (second == GEARED_CRANK)).any()
    chosen = Topology(first, second, topology.side[:, dyads], topology.form[:, dyads], ratio)
    return np.concatenate(parts), chosen
