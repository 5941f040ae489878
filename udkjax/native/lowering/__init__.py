"""JAX functions of one member as machine code in lanes: the lowering of a jaxpr with its arrays and loops.

`arrays` has arrays in memory and arrays whose elements are computed where they are read; `lowering` the memory, loops and
branches; `rules` the primitives of JAX, with `views`, `reductions`, `updates`, `solving` and `decompositions`; `module_calls` the
calls of a module's functions; `varying` decides which arrays may differ between lanes; `own_objects` writes methods of
user-defined objects as functions, whose text is stored on disk under a key (`source_key`). Every computed array has memory of its
own, and only the states of loops are overwritten, when all next states are known: no operation can read a number that another has
replaced.

Rules have the arguments `to`, the lowering; `inputs`, the operands; `p`, the parameters of the primitive; and `out`, the shape
and dtype of the result. They write code into the function of the lowering, and return the result as an `Array`.
"""
