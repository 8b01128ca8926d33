"""What is asked of equilibria: stability, branches, errors, inverse design."""
