"""Equilibria: Newton's method, continuation, the implicit derivative, ramps and sweeps.

When to use what:

- `equilibrium` for one command. It jumps there from rest, or from `x0`. Where a command has several equilibria, it may
  find another one than a beam that is pulled slowly.
- `ramp` where the way matters: for curves against actuation, for animations, and beyond a snap, where the state depends
  on the path.
- `sweep` for many commands whose order does not matter, such as a map of what the tip can reach. It costs one or two
  Newton steps a command and uses all cores.
- `linear_response` for small deflections: one linear solve, which does not tell its error.

The first three never raise for a solve that fails: pass the solution through `check`. To follow equilibria through
folds, where a ramp must jump, use `trace_branch`.
"""
