"""Sweeps: many runs that differ in parameters, settings and methods, as one dataset.

axes, dimensions, grid      what varies: as users write it, as dimensions, as a TOML file
measures                    what is stored of each member
plan, groups                members and their groups; what is computed of those of a group
chunks, executors           members that take a few seconds together, computed on devices or on a cluster
store, fingerprint          finished chunks on disk; what decides the results
dataset                     all results, labelled
sweep                       what users call, and how far it is
"""

from udkjax.study.sweep.axes import Axis as Axis
from udkjax.study.sweep.axes import LatinHypercube as LatinHypercube
from udkjax.study.sweep.axes import Random as Random
from udkjax.study.sweep.axes import Sobol as Sobol
from udkjax.study.sweep.axes import Zipped as Zipped
from udkjax.study.sweep.dimensions import SweepError as SweepError
from udkjax.study.sweep.sweep import sweep as sweep
