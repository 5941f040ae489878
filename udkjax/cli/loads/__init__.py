"""Commands about forces and rest: drives, reactions, equilibria, small oscillations."""
