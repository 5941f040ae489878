"""The foundation of all machine code: text, memory and modules, and the way from text to an operation of XLA.

A *member* is one run of a batch. A *lane* is one of the W positions of a vector, which all run the same instructions: a member
occupies one lane. A *register* holds `vector` float64 numbers, several coordinates of one member or one of W members. A *slot*
is a number of a loop's array: a base column of the table and an offset. The *call record* is the list of counts and addresses
that `run` is called with. A *tangent* is the memory of one direction of a derivative, a *row* of samples the values of sampled
numbers between two breakpoints.
"""
