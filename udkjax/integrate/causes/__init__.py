"""Why a run failed: what happened where, found after a single run by NumPy on the scene's programs."""
