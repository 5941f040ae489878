"""Answers of an identification: the estimate, its uncertainty, profile likelihoods, and checks of gradients."""
