"""The instant of an event: impacts, joints that stick, jumps of phases, and the loop that applies them, member by member.

Nothing here knows how a run is integrated: the loop asks the interface in `system`, which `run` implements.
"""
