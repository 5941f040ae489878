"""Sweeps: many runs that differ in parameters, settings and methods, collected in a dataset.

axes, dimensions, grid      the varied quantities: in Python, as dimensions, and in a TOML file
measures                    the variables stored for each member
plan, groups                members (the single runs) and groups of members with a common compiled program
chunks, executors           chunks of members that take a few seconds, computed on devices or on a cluster
store, fingerprint          finished chunks on disk; all inputs that determine the results
dataset                     all results, labelled
sweep                       the public function and its progress
"""

from udkjax.study.sweep.axes import Axis as Axis
from udkjax.study.sweep.axes import LatinHypercube as LatinHypercube
from udkjax.study.sweep.axes import Random as Random
from udkjax.study.sweep.axes import Sobol as Sobol
from udkjax.study.sweep.axes import Zipped as Zipped
from udkjax.study.sweep.dimensions import SweepError as SweepError
from udkjax.study.sweep.sweep import sweep as sweep
