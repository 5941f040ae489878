"""One module of machine code: its functions, the layout of its memory, the control of steps, and the call of a run.

A *member* is one run of a batch. A *lane* is one of the W positions of a vector: all lanes execute the same instructions, and
each holds one member. A *slot* addresses a number in a loop's array, by a base column of the table and an offset. The *call
record* is the list of counts and addresses that is passed to `run`. A *tangent* is the memory of the derivatives along one
direction. A *row* of samples holds the values of the sampled numbers between two breakpoints. In the code, `s` is the `Lane`
of a function: its attributes are the numbers of each lane, which layout.py lists. Docstrings of methods with an argument `f`
describe the effect of the code that they write into the function `f`; a *hook* writes none unless it is overridden. The
algorithms are in `run`, `derivatives`, `watching` and `closing`, which may use all of this.
"""
