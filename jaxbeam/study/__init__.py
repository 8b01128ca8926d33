"""Studies of equilibria: stability, branches, error estimates, inverse design."""
