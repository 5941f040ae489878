"""The static side of events: their conditions and actions, and the phases of a run that follow from these, without any state.

Everything here is known before a run begins; a new action or condition is added here, and `instant` applies it.
"""
