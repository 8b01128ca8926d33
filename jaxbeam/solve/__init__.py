"""Equilibria: Newton's method, continuation, the implicit derivative, ramps and sweeps."""
