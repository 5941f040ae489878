"""Identification of a mechanism's parameters from measured motion.

records, tables, record_reader                     measurements, from files and tables
parameters, unknowns                               parameters to identify, and the unknowns of a fit
prediction, fit_problem, shooting                  predictions and residuals
loop_consistency                                   parameters that keep closed loops closed
windows, residuals                                 residuals and their Jacobian in blocks of rows, and their reduction
least_squares, optimizer                           minimization
growing_records, search                            search for the global minimum
row_statistics, uncertainty, profile_likelihood    standard errors and confidence intervals
gradient_check                                     check of derivatives against differences
identification, estimate, experiment_design        the public functions and their results
"""

from udkjax.positions.channels import Quantity as Quantity
from udkjax.study.identify.estimate import Estimate as Estimate
from udkjax.study.identify.experiment_design import Candidate as Candidate
from udkjax.study.identify.experiment_design import Design as Design
from udkjax.study.identify.experiment_design import design_experiment as design_experiment
from udkjax.study.identify.gradient_check import GradientCheck as GradientCheck
from udkjax.study.identify.gradient_check import check_gradients as check_gradients
from udkjax.study.identify.identification import identify as identify
from udkjax.study.identify.parameters import Parameter as Parameter
from udkjax.study.identify.parameters import length as length
from udkjax.study.identify.records import IdentificationError as IdentificationError
from udkjax.study.identify.records import Record as Record
from udkjax.study.identify.records import Start as Start
