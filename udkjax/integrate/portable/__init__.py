"""The engine of one mechanism as data that a page can run without Python: WebAssembly, and the meaning of its numbers.

`portable_engine` returns it. Its contents:

format       1
bodies       names; a state is q, which has x, y (m) and angle (rad) of each body in turn, and v, their rates
parameters   a list of {name, unit, value}: numbers of the scene that may change, in the order in which they are given
numbers      base64 of float64: all numbers of the scene (`count` of them), the times (s) where its motion is not smooth (`knots`
             of them), the numbers of the `conditions` of events and, if requested, the `drawn_points`
events       null without events, else {names; directions in which zeros count, 0 for either; by_velocity: masks; stops: whether
             each ends the run; restitution of an impact, else null; ends_at_rest: whether its rest ends the run; slowest: rate
             of the scene (1/s); most: largest number of events; head: number of entries of a crossing before the sides of
             conditions; tolerances of integrate/events, by name}
held         engines of the same mechanism with the contact of one event at rest, by the index of that event; without "close"
forces_watched  1 for an engine in `held`, whose run also ends where the contact would have to pull; else 0
thresholds   thresholds of pivots, the inputs of a run after the numbers; closing uses those in `closing`
closing      {thresholds, settings, tol and rounding: what counts as closed (equations/rows/position_closure.py)}
guess        {q, v}: places in `numbers` of the initial guess
rows         scales of the rows of Psi (m, rad)
scales       {length (m), rate (1/s), mass (kg)}
marks        number of rows of Psi with a mark, after the numbers: 1 for independent rows, which the module "mark" computes; 0 if
             all rows are independent
settings     settings of a run, by name, in order; `smallest` and `omega` follow from the times and the state
smallest     smallest step, in units of rounding of the end time
drift_tol    violation of Psi, in units of the rows' scales, beyond which a run has failed
info         names of the first numbers of a run's result "info", which are followed by its last q and v
sampled      places in `numbers` of sampled quantities; `samples`: base64 of float64, a row for each interval between breaks
masses       for each body the places in `numbers` of its mass and inertia
efforts      a list of {driver, unit, row of Psi, place of that row in x0}
friction     whether there is friction, whose power the module "evaluate" computes
forces       how to compute the forces of joints if no row is redundant
pulls        for each body the places in `numbers` of a spring that pulls it: point x, y, target x, y, stiffness, damping; or []
why          the reason why there is no "run"; else empty
modules      run, states (conditions of events), close, evaluate, mark: {code: base64 of deflated WebAssembly, data_end, fields or
             places and size, settings, inputs, results}

udkjax/show/player/engine.js runs it: `loadEngine(data)` returns an object with `close(parameters, guess)` and
`run(parameters, state, times)`; their results are described in that file.
"""

from udkjax.integrate.portable.engine import PortableEngine, drawn_points, portable_engine
from udkjax.integrate.portable.parameters import scalar_parameters
from udkjax.integrate.portable.portable_events import unknown_friction

__all__ = ["PortableEngine", "drawn_points", "portable_engine", "scalar_parameters", "unknown_friction"]
