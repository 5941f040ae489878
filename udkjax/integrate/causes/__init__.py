"""Causes of failed runs: place, time and reason, found after a single run by NumPy on the scene's programs."""
