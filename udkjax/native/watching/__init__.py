"""Runs that watch conditions, and end where one of them crosses zero.

A *condition* g(t, q, v) or a contact force is evaluated at *nodes* within accepted steps, two *intervals* at a time; its *side*
is its last nonzero sign. An interval is *resolved* if the condition certainly crosses zero once or not at all; other intervals
are refined, and are *unresolved* if a refinement does not help. A *window* is the span of 32 intervals. A *jump* is a change that
no refinement resolves. A *landing* is a step that ends at a crossing. A run *passes* an event if machine code handles it, and the
run goes on; other events end the run, and Python decides.

Functions with an argument `f` add instructions to this function of the module; its argument `s` gives access to the numbers of
all lanes, which module/layout.py and watch_memory.py describe. Sets of lanes, such as `mask`, are masks.
"""
