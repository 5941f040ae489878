"""Quantities of the equations of motion at a state, each as one compiled program: what `udkjax.equations` offers to its users."""

from udkjax.equations import constraints, determinacy, loads
from udkjax.equations.compiled import compiled

psi = compiled(constraints.psi)
psi_q = compiled(constraints.psi_q)
psi_dot = compiled(constraints.psi_dot)
gamma = compiled(constraints.gamma)
force = compiled(loads.force)
mass = compiled(loads.mass)
kinetic_energy = compiled(loads.kinetic_energy)
potential_energy = compiled(loads.potential_energy)
singular_values = compiled(determinacy.singular_values)
uniqueness = compiled(determinacy.uniqueness)
