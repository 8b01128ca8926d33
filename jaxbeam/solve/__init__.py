"""Equilibria: Newton's method, continuation, the implicit derivative, ramps and sweeps.

When to use what:

- `equilibrium` for one command. It jumps there from rest, or from `x0`. Where a command has several equilibria, it may
  find another one than a beam that is pulled slowly.
- `ramp` where the way matters: for curves against actuation, for animations, and beyond a snap, where the state depends
  on the path.
- `sweep` for many commands whose order does not matter, such as a map of what the tip can reach. It costs one or two
  Newton steps a command and uses all cores.
- `linear_response` for small deflections: one linear solve, which does not tell its error.

The first call of each compiles, which takes 2 to 3 s for `equilibrium`. Called outside `jit` they compile with XLA's
older CPU emitters and without three of its passes: in less than half of the time, for programs that run as fast. For a
`jit` of your own around them the same is had, with jaxlib 0.10, by the environment variable XLA_FLAGS:

    --xla_cpu_use_fusion_emitters=false
    --xla_disable_hlo_passes=while-loop-invariant-code-motion,simplify-while-loops,tree_reduction_rewriter

A `jax.vmap` of your own over `equilibrium` solves lane after lane, and costs what `lax.map` does.

The first three never raise for a solve that fails: pass the solution through `check`. To follow equilibria through
folds, where a ramp must jump, use `trace_branch`.
"""
