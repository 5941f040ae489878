"""Reading JAX: a jaxpr becomes a graph of scalars, primitive by primitive; a new primitive is a rule here."""
