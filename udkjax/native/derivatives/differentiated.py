"""The base of forward and reverse mode of a trajectory: the differentiated programs, evaluated at the same states."""

from udkjax.native.language.ir import Function
from udkjax.native.module.layout import Lane, Plan
from udkjax.native.module.program_derivative import ProgramDerivative
from udkjax.native.module.programs import DIFFERENTIATED_OUTPUTS
from udkjax.native.run.trajectory import Trajectory


class Differentiated(Trajectory):
    """Base of forward and reverse mode: programs of derivatives, and memory for their intermediate results.

    `active` marks the numbers of the scene with respect to which derivatives are needed; those with respect to positions and
    velocities always are.
    """

    def __init__(self, plan: Plan, active: tuple[bool, ...]):
        differentiated = ("accelerations", "projection") if plan.projected else ("accelerations",)
        super().__init__(plan, differentiated, active)
        self.active, self.count, self.last = active, len(self.moving), plan.method.stages
        # For each active number with samples: its column among the samples, and its index among the numbers.
        self.active_samples = {k: place for k, place in enumerate(plan.sampled) if active[place]}
        self.of_accelerations = ProgramDerivative(self, "accelerations")
        self.of_projection = ProgramDerivative(self, "projection") if plan.projected else None
        for i in range(1, self.last + 1):  # the last is at the end of the step
            self.places.add(f"stage{i} linearization", self.of_accelerations.stored_size)
        if self.of_projection:
            self.places.add("projection linearization", self.of_projection.stored_size)

    def evaluate_stage(self, f: Function, i: int):
        """Compute the accelerations of stage i with the intermediate results that derivatives need."""
        self.evaluate_settled(f, f"stage{i} a", f"stage{i} linearization")
        self.accelerations.accelerate_exactly(f, f"stage{i} a")  # derivatives are the same for all methods

    def evaluate_settled(self, f: Function, out: str, stored: str):
        """Compute accelerations at `state`, with settled friction, and the intermediate results that their derivatives need.

        They are stored in the arrays `out` and `stored`.
        """

        def settle():
            self.friction.settle(f, out)

        def evaluate():
            f.call("evaluation", f.given["work"], self.address(f, out), self.address(f, stored))

        settle()
        self.fallback.evaluate_settled(f, Lane(f, self.places), settle, evaluate)

    def _evaluate_solved(self, f: Function, i: int):
        """Compute the intermediate results for derivatives at the state of solved stage i, and factorize its matrix D there."""
        self.evaluate_settled(f, "residual a", f"stage{i} linearization")
        f.call("factor_exact", f.given["work"])

    def _solve_transposed(self, f: Function, name: str):
        """Replace w, the cotangents of the accelerations of a solved stage in the array `name`, by D^(-T) w."""
        d = self.stiffness.exact(f)
        with f.each(self.rowcount) as r:
            d.row("x")[r] = self.vector(f, name, r)
        f.call("solve_exact_transposed", f.given["work"])
        with f.each(self.rowcount) as r:
            self.put(f, name, r, d.row("b")[r])

    def write_programs(self):
        super().write_programs()
        for derivative in self._linearizations:
            derivative.evaluation()
        if self.unrolled and self._shares_factors:
            names = ("accelerations", "projection")
            at = {f"stored {name}": (name, 0) for name in names} | self.arrays
            program = self.unrolled.evaluations({name: DIFFERENTIATED_OUTPUTS[name] for name in names})
            self.write_scalars(program, "evaluation_end", ("work", *names), at)

    @property
    def _linearizations(self) -> list[ProgramDerivative]:
        """The derivatives of the module's programs: of the accelerations and, if states are projected, of the projection."""
        return [x for x in (self.of_accelerations, self.of_projection) if x]

    @property
    def _shares_factors(self) -> bool:
        """True if one program evaluates accelerations and projection at the end of a step, with a common factorization.

        With friction that depends on loads, the accelerations may leave out more rows than the projection.
        """
        return bool(self.unrolled and self.of_projection) and not self.friction.settles

    def _evaluate_end(self, f: Function):
        """Compute the intermediate results for derivatives of accelerations and projection at the end of a step."""
        stored = f"stage{self.last} linearization"
        if self._shares_factors:
            f.call("evaluation_end", f.given["work"], self.address(f, stored), self.address(f, "projection linearization"))
        else:
            self.evaluate_settled(f, "corrected q", stored)
            self._evaluate_projection(f)

    def _evaluate_projection(self, f: Function):
        """Compute the intermediate results for derivatives of the projection at the state, which lies on the manifold."""
        if self.of_projection:
            f.call("evaluation_projection", f.given["work"], f.given["work"], self.address(f, "projection linearization"))
