"""The parts of a module that integrates. Each has the programs and the memory that it needs, and the functions that it writes.

- Accelerations: `elimination`, or `dense_equations` by a pseudoinverse of all rows (pseudoinverses/). `formulations` has
  alternatives to the Udwadia-Kalaba equation, `own_formulation` user-defined ones, and `partitioning` one that integrates
  independent coordinates alone.
- Projection: `projection` returns the ends of steps to the constraints by Newton's method (`manifold`), or leaves them as they
  are; `stabilized` runs a user-defined stabilization (`own_stabilization`).
- Fallback: `fallback` takes the steps whose pivots are too small for elimination, by a method of `all_rows`; `singular` decides
  about steps near singular configurations.
- Implicit steps of stiff motions are in run/stiffness.py.

Functions with an argument `f` add instructions to this function of the module; its argument `s` gives access to the numbers of
all lanes, which module/layout.py describes. Sets of lanes, such as `accept`, are masks.
"""
