"""Identification: parameters of mechanisms, found from measured motion.

records, tables, record_reader                     measurements, whatever they come as
parameters, unknowns                               what is to be found
prediction, fit_problem, shooting                  what would be measured, and how far it is from what was
loop_consistency                                   whether parameters fit the mechanism's loops
least_squares, optimizer                           minimization
growing_records, search                            from guesses that lead to the minimum
uncertainty, profile_likelihood                    how well the parameters are known
gradient_check                                     whether derivatives are right
identification, estimate, experiment_design        what users call, and what they get
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
