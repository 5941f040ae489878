"""Laws of constrained motion: the Udwadia-Kalaba equation, and other formulations of the same accelerations, on arrays.

The interface that an integrator calls is `abstract_system`; a formulation needs nothing but the arrays that it is given.
"""
