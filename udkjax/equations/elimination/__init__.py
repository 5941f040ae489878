"""Linear systems of a scene, solved by elimination in an order that is chosen once: multipliers, with and without friction.

A program may use any of these systems; their code does not depend on the quantities that are solved for. Pseudoinverses of given
matrices are in `pinv`.
"""
