"""Positions along a drive: a curve followed by its arc length, through dead points, on one branch or all, in batches.

`kinematics` has the public function. Time is the value of the drive here; nothing depends on masses or forces.
"""
