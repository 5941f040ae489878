"""The posterior density of unknowns: priors, and the likelihood of records as a function of JAX.

The predictions, residuals and transforms are those of `problem`.
"""
