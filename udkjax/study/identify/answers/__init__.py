"""Answers of an identification: the estimate, its uncertainty, checks of gradients, and the design of further experiments."""
