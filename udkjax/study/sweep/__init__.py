"""Sweeps: many runs that differ in parameters, settings and methods, as one dataset."""

from udkjax.study.sweep.axes import Axis as Axis
from udkjax.study.sweep.axes import LatinHypercube as LatinHypercube
from udkjax.study.sweep.axes import Random as Random
from udkjax.study.sweep.axes import Sobol as Sobol
from udkjax.study.sweep.axes import Zipped as Zipped
from udkjax.study.sweep.layout import SweepError as SweepError
from udkjax.study.sweep.sweep import sweep as sweep
