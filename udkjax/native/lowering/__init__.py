"""JAX functions of one member as machine code in lanes: the lowering of a jaxpr with its arrays and loops.

`arrays` has arrays in memory and those that are evaluated where they are read; `lowering` the memory, loops and branches; `rules`
the primitives of JAX (`views`, `reductions`, `updates`, `solving`); `varying` decides which arrays may differ between lanes;
`own_objects` writes methods of user-defined objects as functions, whose text is stored on disk by `source_key`. Every computed
array has memory of its own, and only the states of loops are overwritten, when all next states are known: no operation can read
what another has replaced.
"""
