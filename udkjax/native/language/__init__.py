"""The language that machine code is written in: values, branches and loops of LLVM's text, elementary functions, programs.

A *member* is one run of a batch. A *register* holds `vector` float64 numbers: several coordinates of one member, or one
coordinate of W members. In the code, `f` is the function that is written, `r` is the index of a register, and `k` the index of
a lane or of an entry. This folder knows nothing about runs: the text that it writes depends on its arguments alone.
"""
