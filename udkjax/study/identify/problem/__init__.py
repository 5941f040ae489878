"""The least-squares problem of an identification: unknowns, predictions, residuals and their Jacobian, in blocks of rows.

Searches and answers use the same problem; a new kind of unknown is added here alone.
"""
