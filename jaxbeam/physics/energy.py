"""Terms of the energy: one stencil's pure energy, the nodes it acts on, and its parameters.

A `Term` is all the solver knows of physics. Forces, stencil Hessians, their projection, assembly, the
derivative through equilibrium and the batch axis follow from its three fields. A term's force on the body
is minus the gradient of its energy; a tendon's tension is positive when it pulls its ends together.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.tree import Numbers, index_field, is_concrete, pytree, read_only, static_field, to_device
from jaxbeam.mesh.mesh import Mesh


@pytree
class Term:
    """`m` stencils that share one energy.

    Args:
        energy: pure function `(x, params) -> scalar` of one stencil, `x` `(k, 2)` the positions of its
            nodes and `params` one stencil's parameters. Make it a module-level function (or a hashable
            callable): a lambda made anew for every scene would be compiled anew.
        nodes: `(m, k)` node numbers.
        params: any pytree of arrays with leading axis `m`. All of it is differentiable. Values that change
            belong here, never in a closure, or each change compiles again.

    Raises:
        ValueError: if `nodes` is not a whole-number array of shape `(m, k)`, or an array of `params` has
            another leading axis.
    """

    energy: Callable[[jax.Array, Any], jax.Array] = static_field()
    nodes: np.ndarray = index_field()
    params: Any

    def __post_init__(self) -> None:
        if not callable(self.energy):
            raise ValueError(f"energy: expected a function (x, params) -> scalar, got {self.energy!r}")
        wanted = "concrete whole numbers of shape (m, k)"
        nodes = checks.plain("nodes", self.nodes, wanted) if is_concrete(self.nodes) else None
        if nodes is None or nodes.dtype.kind not in "iu" or nodes.ndim != 2 or 0 in nodes.shape:
            got = "a traced array" if nodes is None else f"shape {nodes.shape} of dtype {nodes.dtype}"
            raise ValueError(f"nodes: expected {wanted}, got {got}")
        object.__setattr__(self, "nodes", read_only(nodes, np.int32))
        named = lambda path, leaf: checks.parameter(f"params{jax.tree_util.keystr(path)}", leaf)
        params = jax.tree.map(to_device, jax.tree_util.tree_map_with_path(named, self.params))
        for path, leaf in jax.tree_util.tree_leaves_with_path(params):
            if leaf.ndim == 0 or leaf.shape[0] != nodes.shape[0]:
                raise ValueError(
                    f"params{jax.tree_util.keystr(path)}: expected leading axis {nodes.shape[0]}, one entry for each "
                    f"stencil, got shape {leaf.shape}; use jnp.broadcast_to or jnp.full for a shared value"
                )
        object.__setattr__(self, "params", params)


def check_nodes(name: str, mesh: Mesh, nodes: Numbers, ndim: int) -> np.ndarray:
    """`nodes` as a concrete array of valid node numbers with `ndim` axes, or a `ValueError` that names it."""
    checks.instance("mesh", mesh, Mesh, "a scene has it as scene.mesh")
    return checks.node_numbers(name, mesh.nodes.shape[0], nodes, ndim)
