"""The foundation of all machine code: text, memory and modules, and the way from text to an operation of XLA.

A *member* is one run of a batch. A *lane* is one of the W positions of a vector: all lanes execute the same instructions, and
each holds one member. A *register* holds `vector` float64 numbers: several coordinates of one member, or one coordinate of W
members. A *slot* addresses a number in a loop's array, by a base column of the table and an offset. The *call record* is the list
of counts and addresses that is passed to `run`. A *tangent* is the memory of the derivatives along one direction. A *row* of
samples holds the values of the sampled numbers between two breakpoints.

In the code, `f` is the function that is written, `s` has the numbers of its lanes, `r` is the index of a register, and `k` the
index of a lane or of an entry.
"""
