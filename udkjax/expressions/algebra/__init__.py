"""Algebra of graphs: derivatives, and sparse factorizations, done while the graph is built."""
