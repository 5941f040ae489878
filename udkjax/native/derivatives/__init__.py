"""Derivatives of runs: tangents in forward mode, and walking back along a record in reverse mode."""
