"""Energies, what they can say of themselves, and the terms of a scene that are made of them.

A `Term` is all the solver knows of physics: one energy, the nodes of its stencils, and their parameters. Forces,
Hessians, assembly and the derivative through equilibrium follow from these. The force of a term on the body is minus
the gradient of its energy.

The energy may be a bare function `(x, params) -> scalar`. What else there is to say of it, it says itself, as a
subclass of `Energy`: how it is commanded, ramped, checked, bounded, refined, drawn and measured. Every method has a
safe default, which is what a bare function gets. The scene, the solver, error estimates and pictures ask these methods
and know no kind of energy by name, so a new kind of physics is one file.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.tree import Numbers, index_field, is_concrete, pytree, read_only, static_field, to_device
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.physics.projection import project_each


class NotRefinable(ValueError):
    """Raised by `Energy.refined`: the term cannot be carried to a finer mesh. The text says why."""


class Energy:
    """The energy of one stencil, and what it can say of itself.

    Make a subclass a frozen dataclass of functions and numbers: it is hashed, and a new value compiles anew. Parameters
    that change belong in `params`. Arguments named `x` are `(m, k, d)` positions of the nodes of `m` stencils, and
    `params` their parameters with leading axis `m`; only `__call__` gets those of a single stencil.
    """

    name: ClassVar[str] = "term"  # what to call a stencil in pictures and messages
    body: ClassVar[bool] = False  # elastic material: its energy is strain energy, and no rigid motion changes it
    fills: ClassVar[bool] = False  # its stencils are elements of area, whose outer edges are the surface of the body
    coordinates: ClassVar[int | None] = None  # coordinates of a node that it is made for: 2, 3 on a rod; None: any
    rest_command: ClassVar[float | None] = None  # command at which it does nothing; None: it is not commanded
    shared_command: ClassVar[bool] = False  # one command for all stencils of a term, and not one for each
    commands: ClassVar[checks.Range] = checks.FINITE  # the range of its commands
    command_unit: ClassVar[float | None] = None  # a change of command of order 1; None: the width of its bounds
    command_hint: ClassVar[str] = ""  # what a command means, for the message about one out of range

    def __call__(self, x: jax.Array, params: Any) -> jax.Array:
        """Energy `()` of one stencil at positions `x` `(k, d)`."""
        raise NotImplementedError

    # ------------------------------------------------------------------------------------ derivatives

    def gradients(self, x: jax.Array, params: Any) -> tuple[jax.Array, jax.Array]:
        """Energies `(m,)` and their gradients `(m, k, d)`. By autodiff unless there is a faster way."""
        return jax.vmap(jax.value_and_grad(self))(x, params)

    def hessians(self, x: jax.Array, params: Any, convex: bool = False) -> jax.Array:
        """Hessians `(k d, k d, m)`, by autodiff; with `convex`, the nearest positive semidefinite ones."""
        m, k, d = x.shape
        of_one = lambda flat, params: self(flat.reshape(k, d), params)
        hessians = jax.vmap(jax.hessian(of_one))(x.reshape(m, k * d), params)
        return jnp.moveaxis(project_each(hessians) if convex else hessians, 0, -1)

    # -------------------------------------------------------------------------------------- actuation

    def command(self, params: Any, values: jax.Array) -> Any:
        """The parameters under commands `(m,)`, one for each stencil, or `(1,)` if they share it."""
        return params

    def command_of(self, params: Any) -> jax.Array:
        """The commands `(m,)` or `(1,)` that the parameters are under: the inverse of `command`."""
        raise NotImplementedError

    def partway(self, params: Any, share: jax.Array) -> Any:
        """The parameters with a share of the actuation or the load: none at 0, all at 1."""
        if self.rest_command is None:
            return params
        return self.command(params, (1 - share) * self.rest_command + share * self.command_of(params))

    # ----------------------------------------------------------------------------- ranges and bounds

    def valid(self, params: Any) -> Any:
        """Whether traced parameters are in their range `()`. That they are finite is checked for every term."""
        return True

    def objection(self, term: Term, fixed: np.ndarray) -> str:
        """Why the term cannot act where the coordinates `fixed` `(n, d)` do not move, or nothing."""
        return ""

    def margin(self, x: jax.Array, params: Any) -> jax.Array | None:
        """What must stay positive `(m,)`, such as the smallest `J` of an element; None if there is nothing."""
        return None

    def longest_step(self, x: jax.Array, dx: jax.Array, params: Any, keep: float) -> jax.Array | None:
        """The largest `t` `(m,)` for which the share `keep` of the margin is left at `x + t dx`; None: any."""
        return None

    # ------------------------------------------------------------------------------------- refinement

    def refined(self, term: Term, mesh: Mesh, parts: int) -> Term:
        """The term on a finer mesh, whose elements are `parts` for each one now. Nodes keep their numbers.

        Raises:
            NotRefinable: if it does not say how. Then there is no error bar for a scene with it.
        """
        raise NotRefinable("it does not say what it becomes on a finer mesh (see Energy.refined)")

    def without_limit(self, term: Term, free: np.ndarray) -> str:
        """Why the answer has no limit as the mesh is refined, or nothing. `free` `(n,)`: nodes that move."""
        return ""

    # -------------------------------------------------------------------------- measures and pictures

    def measured(self, x: jax.Array, params: Any) -> dict[str, jax.Array]:
        """What can be measured on each stencil, `(m,)` by name, such as `length` and `tension` of tendons."""
        return {}

    def at_points(self, x: jax.Array, params: Any, measure: Callable[..., jax.Array]) -> jax.Array | None:
        """`measure(H, density, material)` at the quadrature points of elements, `(m, q, ...)`; None without any."""
        return None

    def sides(self, x: jax.Array, params: Any) -> list[jax.Array]:
        """Segments `(m, 2, 2)` that bound a body without elements of area, such as both sides of a rod."""
        return []

    def line(self, x: jax.Array, params: Any) -> jax.Array | None:
        """Points `(m, p, 2)` of the line that each stencil is drawn as, in a colour of its own; None: not drawn."""
        return None

    def arms(self, x: jax.Array, params: Any) -> jax.Array | None:
        """Segments `(m, p, 2, 2)` from the body to the points of the line, where these are not nodes; None: none."""
        return None

    def anchors(self, params: Any) -> tuple[np.ndarray, np.ndarray] | None:
        """Nodes and widths `(m, p)` of the patches of surface that it pulls on, to be drawn; None: none."""
        return None


@dataclasses.dataclass(frozen=True)
class BareFunction(Energy):
    """A function `(x, params) -> scalar` as an energy that says nothing else of itself."""

    function: Callable[[jax.Array, Any], jax.Array]

    def __call__(self, x: jax.Array, params: Any) -> jax.Array:
        return self.function(x, params)


@pytree
class Term:
    """`m` stencils that share one energy.

    Args:
        energy: an `Energy`, or a pure function `(x, params) -> scalar` of one stencil: `x` `(k, 2)` are the positions
            of its nodes and `params` its parameters. Define the function at module level: a lambda made anew for
            every scene would be compiled anew.
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

    def __repr__(self) -> str:
        return f"Term({len(self.nodes)} x {self.kind.name})"

    @property
    def kind(self) -> Energy:
        """The energy with all that it says of itself."""
        return self.energy if isinstance(self.energy, Energy) else BareFunction(self.energy)

    @property
    def command_count(self) -> int:
        """How many commands it takes."""
        if self.kind.rest_command is None:
            return 0
        return 1 if self.kind.shared_command else len(self.nodes)


def check_nodes(name: str, mesh: Mesh, nodes: Numbers, ndim: int) -> np.ndarray:
    """`nodes` as a concrete array of valid node numbers with `ndim` axes, or a `ValueError` that names it."""
    checks.instance("mesh", mesh, Mesh, "a scene has it as scene.mesh")
    return checks.node_numbers(name, mesh.nodes.shape[0], nodes, ndim)
