"""From text to code: compiled for a processor, in parallel, cached on disk under a digest of the text, and interrupted by Ctrl-C.

Only these modules call LLVM and touch the cache. Changing the text of a module needs no change here.
"""
