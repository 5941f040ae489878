"""Measurements: `python -m benchmarks right_hand_side`, `python -m benchmarks simulate`. See README.md."""
