"""The posterior density of unknowns: priors, the likelihood of records as a function of JAX, and its normal approximation.

The predictions, residuals and transforms are those of `problem`.
"""
