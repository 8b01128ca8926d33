"""Studies of equilibria: stability, branches, error estimates, inverse design, fitting.

Inverse design:

- `reach` where the unknowns are the commands and a measure should have a value. It needs a handful of solves, keeps
  bounds, takes the least effort, and says if the target is out of reach.
- `reach_each` for a sequence of targets, such as a path of the tip: each search starts from the answer before.
- `minimise` for all else: unknown shapes, materials or loads, or a loss in place of a target. It has no bounds and
  takes more solves.

Fitting:

- `fit` where the parameters are unknown and equilibria were measured: moduli, Poisson's ratio, rest lengths. It says
  which of them the data determine, with standard errors.
- `predict` for any measure under a new command, with the error that it inherits from the parameters;
  `next_experiment` for the commands that are best measured next.

Errors:

- `estimate_error` for a solution that is there already: an error bar for each measure.
- `corrected` for a better value and its bar at once, for many commands, inside jit and with derivatives. Its two meshes
  are made once by `two_meshes`.
- `solve_to` where a tolerance is given and the mesh is not: it refines until the bar is within the tolerance.
- `choose` before anything is solved: the cheapest model and mesh of a tendon beam for an error, from a table.

The first three tell the error of the mesh, and not that of the model. `model_doubt` tells what speaks against a rod.
`euler_bernoulli` is a hand calculation to compare with.

Stability: `lowest_mode` says how near one state is to a snap. `trace_branch` says where along the way it snaps, and
what branches there are.
"""
