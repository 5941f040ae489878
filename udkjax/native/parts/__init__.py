"""The parts of a module that runs, each with the programs and memory that it needs, and the functions that it writes.

`fallback` takes steps whose pivots are too small for elimination, by one of the methods of `all_rows`; `singular` says when.
`elimination` computes accelerations, `dense_equations` by a pseudoinverse of all rows (pseudoinverses/) instead; `formulations`
has alternatives to the Udwadia-Kalaba equation, `own_formulation` those of users, and `partitioning` one that integrates
independent coordinates alone. `projection` ends steps on the constraints, by Newton's method (`manifold`), or as they are. The
fourth part, implicit steps of stiff motions, has stages of its own in run/stiffness.py.
"""
