"""Runs: steps of a Runge-Kutta method, their control, projection, dense output and fallback, for members in lanes.

A *member* is one run of a batch; it is loaded into a *lane*, one of W that take steps together, and replaced by the next member
when complete. An *attempt* is a step before the controller accepts or rejects it. *Points* 0 to 3 are the latest accepted
states, through which the polynomial of dense output passes; an *output* is a state at a requested time. A *breakpoint* is a
time at which the motion is not smooth, a *piece* a part of the state space in which it is smooth: a step ends at
each breakpoint and at the end of each piece, and the run *begins* anew. The *fallback* takes steps whose pivots are too small for
elimination.

Functions with an argument `f` add instructions to this function of the module; its argument `s` gives access to the numbers of
all lanes, which module/layout.py describes. Sets of lanes, such as `accept`, are masks.
"""
