"""Machine code in programs that JAX compiles for an NVIDIA graphics card: on the host, or as kernels of the card."""
