"""Programs of a scene: loops, or straight-line code, that compute accelerations, Newton steps, projections and positions.

Machine code and NumPy evaluate the same programs. A program is requested by the names of its outputs. A new result is an output
of run_programs.py and scene_writer.py; a new term belongs to `terms`.
"""
