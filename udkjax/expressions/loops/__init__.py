"""Loop programs: small programs repeated over elements of one kind, evaluated by NumPy, JAX or floats, derived and unrolled."""
