"""Programs of a scene: loops, or straight-line code, that compute accelerations, Newton steps, projections and positions.

Machine code and NumPy evaluate the same programs. A new result is a new program here; a new term belongs to `terms`.
"""
