"""Runs that watch conditions, and end where one of them crosses zero.

A *condition* g(t, q, v) or a contact force is evaluated at *nodes* within accepted steps, two *intervals* at a time; its *side*
is its last nonzero sign. An interval is *resolved* if the condition certainly crosses zero once or not at all; other intervals
are refined, and are *unresolved* if a refinement does not help. A *window* is the span of 32 intervals. A *jump* is a change that
no refinement resolves. A *landing* is a step that ends at a crossing.
"""
