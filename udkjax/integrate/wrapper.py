"""A diffrax solver around another one."""

import diffrax
import equinox as eqx


class Wrapper(diffrax.AbstractAdaptiveSolver, diffrax.AbstractWrappedSolver):
    """Passes on to the solver inside whatever diffrax asks, but for the step itself."""

    solver: eqx.AbstractVar[diffrax.AbstractSolver]

    @property
    def root_finder(self):
        """Of an implicit solver: diffrax gives it the tolerances of the step size controller."""
        return self.solver.root_finder  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def scan_kind(self):
        """Of a Runge-Kutta method: some adjoints choose the kind of the loop over its stages."""
        return self.solver.scan_kind  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def term_structure(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.solver.term_structure

    @property
    def interpolation_cls(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.solver.interpolation_cls

    @property
    def term_compatible_contr_kwargs(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.solver.term_compatible_contr_kwargs

    def order(self, terms):
        return self.solver.order(terms)

    def strong_order(self, terms):
        return self.solver.strong_order(terms)

    def error_order(self, terms):
        return self.solver.error_order(terms)

    def init(self, terms, t0, t1, y0, args):
        return self.solver.init(terms, t0, t1, y0, args)

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)
