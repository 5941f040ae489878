"""Machine code in programs that JAX compiles for a graphics card of NVIDIA: on the host, or as kernels of the card."""
