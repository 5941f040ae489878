"""Machine code from the expressions of a scene: the fast engine."""
