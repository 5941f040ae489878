"""Ranges of numbers: limits of designs, tolerances, and the moments of measures to second order."""
