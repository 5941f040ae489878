"""The unrolled programs of a small scene: expressions of one graph, without loops and intermediate arrays.

Results that depend only on numbers of the scene, the `constants`, are computed once for each run by `prologue`. They differ from
the constants of the loops.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from itertools import product
from typing import NamedTuple

from udkjax.equations.programs.differentiable_programs import DifferentiableProgram
from udkjax.equations.programs.run_programs import JACOBIAN_ARRAYS, RETURNED_ARRAYS, RunPrograms
from udkjax.expressions import Graph, Scalar, ScalarProgram, cotangents, frontier, tangents
from udkjax.expressions.loops.loop_derivative import COTANGENT, FORWARD, OTHER, PREFIXES, REVERSE, SECOND, TANGENT, TWICE
from udkjax.expressions.loops.loop_program import LoopProgram
from udkjax.expressions.loops.unroll import ArrayPlace, Arrays, unroll

OutputNames = tuple[str, ...]
SLOPES_KEY = ("slopes",)  # the key of the derivative of the accelerations by the state alone


class UnrolledProgram(NamedTuple):
    """A program, and the place of each of its inputs and outputs."""

    program: ScalarProgram
    inputs: list[ArrayPlace]
    outputs: list[ArrayPlace]


class UnrolledDerivative(NamedTuple):
    """A program, and a program of its derivative: along directions or, in the mode `REVERSE`, the transpose."""

    evaluation: UnrolledProgram  # the results, and "stored": numbers that the derivative needs
    derivative: UnrolledProgram


class Unrolled:
    """Unrolled programs of a scene, by their outputs, and the derivatives of some of them.

    Args:
        programs: The programs as loops.
        asked: The outputs of each program to unroll.
        differentiated: The outputs of each program of `differentiable` to differentiate.
        active: For each input of the prologue, whether derivatives with respect to it are needed.
        mode: Mode of differentiation: `FORWARD`, `TWICE`, or `REVERSE`, from cotangents of the results to those of q, v and the
            constants.
        slopes: Whether to differentiate the accelerations by the state, for `slopes`.
    """

    def __init__(
        self,
        programs: RunPrograms,
        asked: Iterable[OutputNames],
        differentiated: Iterable[OutputNames] = (),
        active: Sequence[bool] = (),
        mode: str = FORWARD,
        slopes: bool = False,
    ):
        graph = self.graph = Graph()
        n, count = programs.coordinate_count, programs.number_count
        # The prologue does not use thresholds of pivots, because they differ between programs.
        groups = ["parameter"] * (count - 2) + ["threshold", "parameter"]
        self.numbers = [graph.input(("numbers", k), group) for k, group in enumerate(groups)]
        sizes = {"t": (1, "time"), "q": (n, "position"), "v": (n, "velocity"), "dq": (n, "change"), "dv": (n, "change")}
        state = {x: {k: graph.input((x, k), group) for k in range(size)} for x, (size, group) in sizes.items()}
        layout = unroll(programs.prologue, {"numbers": dict(enumerate(self.numbers))}, graph)["constants"]
        self._arrays: Arrays = {"constants": layout, **state}
        begins = self._begins = {
            x: {k: graph.input((x, k), "loads") for k in range(programs.scratch[x])} for x in RunPrograms.BEGINS if programs.rubs
        }
        self._results = {}
        for outputs in asked:
            arrays = self._unroll(programs.of(*outputs), begins if programs.goes_on(outputs) else None)
            returned = JACOBIAN_ARRAYS if {"psi_q", "psi_q of q"} & {*outputs} else ()
            self._results[outputs] = _entries(arrays, RETURNED_ARRAYS + returned)
        active_nodes = _depending(graph, [s for s, m in zip(self.numbers, active, strict=False) if m])
        self.moving = [k for k, s in sorted(layout.items()) if s.index in active_nodes]
        """The constants that depend on active numbers; derivatives index only these."""
        self._derivatives = {x: self._differentiate(programs.differentiable.of(*x), n, mode, self.moving) for x in differentiated}
        if slopes:
            accelerations = programs.for_derivatives.differentiable.of("a")
            self._derivatives[SLOPES_KEY] = self._differentiate(accelerations, n, FORWARD, ())
        outputs = [
            s
            for result in (*self._results.values(), *(x for d in self._derivatives.values() for x in d))
            for s in result.values()
        ]
        self.constants = frontier(graph, outputs, lambda node: node.depends <= {"parameter"})
        drop_tol = self.numbers[-2]
        if drop_tol.index in graph.dependencies([s.index for s in outputs]):
            self.constants.insert(0, drop_tol)  # at the same place whatever else a module needs
        self.drop_tol_index = next((k for k, s in enumerate(self.constants) if s.index == drop_tol.index), None)
        self.safe_tol_index = next((k for k, s in enumerate(self.constants) if s.index == self.numbers[-1].index), None)
        self.prologue = ScalarProgram(graph, self.numbers, self.constants)
        self._inputs = {s: ("constants", k) for k, s in enumerate(self.constants)}
        self._inputs |= {s: (x, k) for x, scalars in (state | begins).items() for k, s in scalars.items()}

    def program(self, *outputs: str) -> UnrolledProgram:
        """Return the program of a tuple of outputs that is one of those in `asked`."""
        return self._program(self._results[outputs], {})

    def derivative(self, *of: str) -> UnrolledDerivative:
        """Return the differentiable program of the outputs `of`, one of those in `differentiated`, with its derivative."""
        results, outputs = self._derivatives[of]
        before_seeds = frontier(self.graph, list(outputs.values()), lambda node: not node.depends & {"tangent", "cotangent"})
        others = {s for scalars in self._begins.values() for s in scalars.values()}  # of another state by the time of `reverse`
        stored = [s for s in before_seeds if s not in self._inputs or s in others]
        stored_inputs = {s: ("stored", k) for k, s in enumerate(stored)}
        evaluation = self._program(results | {place: s for s, place in stored_inputs.items()}, {})
        return UnrolledDerivative(evaluation, self._program(outputs, stored_inputs | self._seeds))

    @property
    def slopes(self) -> UnrolledDerivative:
        """The program of the accelerations, with their derivative by q and v but not by numbers."""
        return self.derivative(*SLOPES_KEY)

    def evaluations(self, named: Mapping[str, OutputNames]) -> UnrolledProgram:
        """Return the program of all numbers that the derivatives of some programs need at one state.

        `named` are the outputs of these programs by a name of each; the numbers are in arrays such as "stored NAME".
        """
        stored: dict[ArrayPlace, Scalar] = {}
        for name, outputs in named.items():
            evaluation = self.derivative(*outputs).evaluation
            scalars = zip(evaluation.outputs, evaluation.program.outputs, strict=True)
            stored |= {(f"stored {name}", k): s for (x, k), s in scalars if x == "stored"}
        return self._program(stored, {})

    def prologue_derivative(self, active: Sequence[bool], mode: str) -> UnrolledProgram:
        """Return the program from tangents of the active numbers to tangents of the moving constants, or its transpose."""
        graph, layout = self.graph, self._arrays["constants"]
        numbers = {s: ("numbers", k) for k, s in enumerate(self.numbers)}
        variables = [s for s, is_active in zip(self.numbers, active, strict=False) if is_active]
        values = [layout[k] for k in self.moving]

        def seeds_of(name: str, places: Sequence[int]) -> dict[Scalar, ArrayPlace]:
            return {graph.input((name, k), "tangent"): (name, k) for k in places}

        if mode == REVERSE:
            seeds = seeds_of(COTANGENT + "constants", range(len(values)))
            changes = dict(zip(variables, cotangents(graph, values, list(seeds), variables), strict=True))
            outputs = {(COTANGENT + "numbers", k): changes.get(s, graph.constant(0.0)) for s, (_, k) in numbers.items()}
        else:
            places = [numbers[s][1] for s in variables]
            seeds, changes = {}, {}
            for prefix in (TANGENT, OTHER) if mode == TWICE else (TANGENT,):
                new_seeds = seeds_of(prefix + "numbers", places)
                changes[prefix] = tangents(graph, values, dict(zip(variables, new_seeds, strict=True)))
                seeds |= new_seeds
            if mode == TWICE:
                changes[SECOND] = tangents(graph, changes[TANGENT], dict(zip(variables, new_seeds, strict=True)))
            outputs = {(prefix + "constants", k): s for prefix, scalars in changes.items() for k, s in enumerate(scalars)}
        program = ScalarProgram(graph, [*numbers, *seeds], list(outputs.values()))
        return UnrolledProgram(program, [*numbers.values(), *seeds.values()], list(outputs))

    def _program(self, outputs: dict[ArrayPlace, Scalar], more_inputs: dict[Scalar, ArrayPlace]) -> UnrolledProgram:
        inputs = self._inputs | more_inputs
        program = ScalarProgram(self.graph, list(inputs), list(outputs.values()))
        return UnrolledProgram(program, list(inputs.values()), list(outputs))

    def _unroll(self, program: LoopProgram, more_arrays: Arrays | None = None, linear: str | None = None) -> Arrays:
        return unroll(program, self._arrays | (more_arrays or {}), self.graph, linear)

    @cached_property
    def _seeds(self) -> dict[Scalar, ArrayPlace]:
        """The tangents or cotangents among the inputs of derivatives."""
        return {}

    def _differentiate(
        self, differentiable: DifferentiableProgram, n: int, mode: str, moving: Sequence[int]
    ) -> tuple[dict[ArrayPlace, Scalar], dict[ArrayPlace, Scalar]]:
        """Return the results, and their tangents or, in the mode `REVERSE`, the cotangents of the inputs, by their places."""
        arrays = self._unroll(differentiable.program, self._begins)
        results = {x: range(n) for x in ("a", "q1", "v1") if x in arrays}
        variables = {"constants": moving, "q": range(n), "v": range(n)}
        prefixes, program = PREFIXES[mode], differentiable.in_mode(mode)
        group = "cotangent" if mode == REVERSE else "tangent"
        sources, targets = (results, variables) if mode == REVERSE else (variables, results)
        seeds: Arrays = {}
        for prefix, x in product(prefixes, sources):
            seeds[prefix + x] = {k: self.graph.input((prefix + x, k), group) for k in sources[x]}
        self._seeds |= {s: (x, i) for x, scalars in seeds.items() for i, s in enumerate(scalars.values())}
        derivatives = self._unroll(program, arrays | seeds, None if mode == TWICE else group)
        changes = {}
        for prefix, x in product(prefixes, targets):
            by_index = derivatives.get(prefix + x, {})
            changes |= {(prefix + x, i): by_index.get(k, self.graph.constant(0.0)) for i, k in enumerate(targets[x])}
        return _entries(arrays, ("a", "safe")), changes


def _entries(arrays: Arrays, names: Sequence[str]) -> dict[ArrayPlace, Scalar]:
    return {(name, k): s for name in names for k, s in sorted(arrays.get(name, {}).items())}


def _depending(graph: Graph, scalars: Sequence[Scalar]) -> set[int]:
    """Return the indices of the nodes that depend on any of the scalars, including the scalars themselves."""
    dependent = {s.index for s in scalars}
    for index, node in enumerate(graph.nodes):
        if any(a.index in dependent for a in node.arguments):
            dependent.add(index)
    return dependent
