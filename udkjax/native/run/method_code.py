"""The machine code of a method and of a formulation, or the reason why there is none."""

from typing import Any, NamedTuple

from udkjax.equations.laws.formulations import Augmented, Formulation, NullSpaceQR, NullSpaceSVD
from udkjax.equations.laws.partitioning import CoordinatePartitioning
from udkjax.equations.programs.scales import Scales
from udkjax.equations.terms.scale_program import RANK_TOL
from udkjax.native.language.program import UnsupportedError
from udkjax.native.lowering.own_objects import numbers_of
from udkjax.native.module.layout import FORMULATION_SETTINGS
from udkjax.native.parts.formulations import MASS_SETTING, AugmentedCode, FormulationCode, NullSpaceCode
from udkjax.native.parts.own_formulation import OwnFormulationCode, number_names
from udkjax.native.parts.partitioning import PartitioningCode
from udkjax.native.pseudoinverses import dense_method
from udkjax.native.pseudoinverses.dense import DenseMethod
from udkjax.native.pseudoinverses.lu import LUCode
from udkjax.native.pseudoinverses.one_of import OneOfCode
from udkjax.pinv import Auto, Elimination, Pseudoinverse


def formulation_code(formulation: Formulation) -> FormulationCode | None:
    """Return the machine code of a formulation; None if machine code does not support it.

    Raises:
        UnsupportedError: a user-defined formulation uses an operation without machine code.
    """
    if isinstance(formulation, CoordinatePartitioning):
        return PartitioningCode()
    if type(formulation) in (NullSpaceQR, NullSpaceSVD):  # classes derived from these have a `solve` of their own
        return NullSpaceCode(type(formulation) is NullSpaceSVD)
    if type(formulation) is not Augmented:
        is_pointwise = type(formulation).formulate is Augmented.formulate  # it only solves for a at a given state
        return OwnFormulationCode.of(formulation) if is_pointwise else None
    method = LUCode(relative=True, refuses_singular=True) if formulation.method is None else dense_method(formulation.method)
    return None if method is None or isinstance(method, OneOfCode) else AugmentedCode(method)  # lanes have one method number


class MethodCode(NamedTuple):
    """The machine code of a pseudoinverse method and of a formulation; None stands for the defaults."""

    pseudoinverse: DenseMethod | None  # None: elimination
    formulation: FormulationCode | None  # None: the Udwadia-Kalaba equation

    @classmethod
    def of(cls, method: Pseudoinverse, formulation: Formulation | None = None) -> "MethodCode":
        """Return the machine code of a pseudoinverse method and of a formulation (None: the Udwadia-Kalaba equation).

        Raises:
            UnsupportedError: machine code does not support one of them.
        """
        code = cls(dense_method(method), None if formulation is None else formulation_code(formulation))
        if formulation is not None and code.formulation is None:
            raise UnsupportedError(f"the formulation {formulation}")
        if code.pseudoinverse is None and not isinstance(method, Auto | Elimination):
            raise UnsupportedError(f"the pseudoinverse {type(method).__name__}")
        return code

    @staticmethod
    def formulation_settings(formulation: Any, scales: Scales) -> dict[str, Any]:
        """Return the settings of a formulation by name.

        They are the characteristic mass (kg), and the rank tolerance or, for a user-defined formulation, its numbers.
        """
        if isinstance(formulation_code(formulation), OwnFormulationCode):
            numbers = [number for x in numbers_of(formulation) for number in x.reshape(-1)]
            return {MASS_SETTING: scales.mass, **dict(zip(number_names(len(numbers)), numbers, strict=True))}
        if isinstance(formulation, Augmented):
            tol = None if formulation.method is None else formulation.method.rank_tol
            tol = RANK_TOL**2 if tol is None else tol
        else:
            tol = scales.rank_tol if formulation.rank_tol is None else formulation.rank_tol
        return dict(zip(FORMULATION_SETTINGS, (tol, scales.mass), strict=True))
