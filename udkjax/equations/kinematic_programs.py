"""The programs of a driven mechanism that its positions alone need: a Newton step, and derivatives by the driver's value."""

from functools import cached_property, lru_cache

from udkjax.equations.scalar_equations import scalar_equations
from udkjax.equations.scene_programs import EliminationPrograms
from udkjax.equations.structure import Shapes, TreeDef, structure
from udkjax.expressions import ScalarProgram
from udkjax.pinv.rank_policy import RankPolicy
from udkjax.scene.mechanism import Mechanism


class KinematicPrograms(EliminationPrograms):
    """Programs whose time is the driver's value s. Redundant rows are left out, others that depend are dropped."""

    def _eliminate(self):
        super()._eliminate()
        graph, e = self.graph, self.equations
        zero = graph.constant(0.0)
        at_rest = graph.substitute([e.psi_dot[i] for i in self.independent_rows], {v.index: zero for v in e.v})
        first = [-x for x in self.minv_jt(self.solve_gram(at_rest))]
        rates = {v.index: x for v, x in zip(e.v, first, strict=True)}
        second = self.minv_jt(self.solve_gram(graph.substitute([e.gamma[i] for i in self.independent_rows], rates)))
        self._outputs["value_derivatives"] = [*first, *second, *e.psi, self._factors_dropping.distance(graph)]

    @cached_property
    def value_derivatives(self) -> ScalarProgram:
        """q' and q'' of Psi_q q' = -Psi_s and Psi_q q'' = gamma; Psi of all rows; `SparseFactors.distance`."""
        return self._program("value_derivatives")


@lru_cache(maxsize=64)
def _kinematic_programs(tree: TreeDef, shapes: Shapes, redundant_rows: tuple[int, ...]) -> KinematicPrograms:
    return KinematicPrograms(scalar_equations(tree, shapes), redundant_rows, False, RankPolicy.DROP)


def kinematic_programs(mechanism: Mechanism, redundant_rows: tuple[int, ...]) -> KinematicPrograms:
    """Return the programs of a mechanism's structure, without rows that are redundant."""
    return _kinematic_programs(*structure(mechanism), redundant_rows)
