"""Machine code from LLVM's text: compiled in parallel for a processor, cached on disk under a digest of the text, and loaded.

Runs of this code can be interrupted by Ctrl-C. Only these modules call LLVM and touch the cache. Changing the text of a module
needs no change here.
"""
