"""Machine code in programs that JAX compiles for a graphics card of NVIDIA."""
