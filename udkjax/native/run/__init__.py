"""Runs: steps of a Runge-Kutta method, their control, projection, dense output and fallback, for members in lanes."""
