"""The door of `programs`: the names that floors above import, each from its own module."""

from udkjax.programs.control_flow import BY_JAX as BY_JAX
from udkjax.programs.control_flow import BY_NUMPY as BY_NUMPY
from udkjax.programs.control_flow import ControlFlow as ControlFlow
from udkjax.programs.control_flow import ConvertsItself as ConvertsItself
from udkjax.programs.control_flow import by_numpy_arrays as by_numpy_arrays
from udkjax.programs.control_flow import cond_of_batch as cond_of_batch
from udkjax.programs.control_flow import sequential as sequential
from udkjax.programs.control_flow import solve as solve
from udkjax.programs.deferred import deferred as deferred
from udkjax.programs.deferred import deferred_p as deferred_p
from udkjax.programs.deferred import trace_once as trace_once
from udkjax.programs.deferred import traced_once as traced_once
from udkjax.programs.identity_cache import cached_by_identity as cached_by_identity
from udkjax.programs.identity_cache import cached_by_size as cached_by_size
from udkjax.programs.identity_cache import is_concrete as is_concrete
from udkjax.programs.numpy_program import Meter as Meter
from udkjax.programs.numpy_program import TooLongError as TooLongError
from udkjax.programs.numpy_program import evaluate_as as evaluate_as
from udkjax.programs.numpy_program import expand_as as expand_as
from udkjax.programs.numpy_program import expansion_of as expansion_of
from udkjax.programs.numpy_program import has_rules as has_rules
from udkjax.programs.numpy_program import numpy_program as numpy_program
from udkjax.programs.numpy_rules import RULES as RULES
from udkjax.programs.numpy_rules import UFUNCS as UFUNCS
from udkjax.programs.numpy_rules import exact_rule as exact_rule
from udkjax.programs.undefined import at_each as at_each
from udkjax.programs.undefined import defined as defined
from udkjax.programs.undefined import defined_along as defined_along
from udkjax.programs.undefined import whole as whole
from udkjax.programs.varying_axes import result_type as result_type
from udkjax.programs.varying_axes import vary_together as vary_together
from udkjax.programs.varying_axes import zero_of as zero_of

__all__: list[str]
