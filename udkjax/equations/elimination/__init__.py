"""Linear systems of a scene, solved by elimination in an order that is chosen once: multipliers, with and without friction.

A program may use any of them; none knows which quantities are solved for. Pseudoinverses of given matrices are in `pinv`.
"""
