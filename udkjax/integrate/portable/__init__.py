"""The engine of one mechanism as data that a page can run without Python: WebAssembly, and the meaning of its numbers.

`portable_engine` returns this data, whose contents are:

format       2
bodies       names; a state is q, which has x, y (m) and angle (rad) of each body in turn, and v, their rates
parameters   a list of {name, unit, value}: numbers of the scene that may change, in the order in which they are given
numbers      base64 of float64: all numbers of the mechanism that serves all phases (`count` of them), the times (s) where its
             motion is not smooth (`knots` of them), numbers of events (`of_events`: the counts of those of conditions, of
             actions, and of joints that events add) and, if requested, the `drawn_points`
events       null without events and joints with set-valued friction, else {names: of all events that may be listed; kept: the
             inputs of the module "instants" that a run keeps between two instants; starts: those of their values at the start
             that are not zero; watched: the conditions and forces that end a stretch of motion; directions: in which their zeros
             are events; zeros: bounds below which conditions are zero, relative to their scales; zero: the same for forces;
             slowest: rate of the scene (1/s); most: largest number of events; head: number of entries of a crossing before the
             sides of conditions; switches: [place in `numbers`, index in the phase]; switch_of_row: that index for each row of
             Psi, -1 for rows that always hold; joints: places of the numbers of joints that events add, and of sides; sticking:
             by joint [index in the phase, index in `joints`] of two numbers, one of which is 1 while the joint sticks; no_event,
             results and words: codes of the instants, and reasons why runs end}
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
shared       null, or the redundant rows that share the loads of joints with friction: the engine has code for these alone
sampled      places in `numbers` of sampled quantities; `samples`: base64 of float64, a row for each interval between breaks
masses       for each body the places in `numbers` of its mass and inertia
efforts      a list of {driver, unit, row of Psi, place of that row in x0}
friction     whether there is friction, whose power the module "evaluate" computes
forces       how to compute the forces of joints if no row is redundant
pulls        for each body the places in `numbers` of a spring that pulls it: point x, y, target x, y, stiffness, damping; or []
why          the reason why there is no module "run"; "" if there is one
modules      run, close, evaluate, mark; with events also states (conditions of events), project (velocities) and instants
             (instants.py): {code: base64 of deflated WebAssembly, data_end, fields or places and size, settings, inputs, results}

udkjax/show/player/engine.js runs the engine: `loadEngine(data)` returns an object with `close(parameters, guess)` and
`run(parameters, state, times)`; their results are described in that file.
"""

from udkjax.integrate.portable.engine import PortableEngine, drawn_points, portable_engine
from udkjax.integrate.portable.parameters import scalar_parameters
from udkjax.integrate.portable.portable_events import names_of_run

__all__ = ["PortableEngine", "drawn_points", "names_of_run", "portable_engine", "scalar_parameters"]
