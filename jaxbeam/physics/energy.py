"""The interface of energies, and the terms of a scene.

A scene is a sum of terms. A `Term` is one energy function, the nodes of the stencils (elements, tendons, loaded nodes)
that it applies to, and their parameters. The solver knows nothing else of physics. Forces, Hessians, assembly and the
derivative through equilibrium follow from these. The force of a term on the body is minus the gradient of its energy.

The energy may be a bare function `(x, params) -> scalar`. To do more, write it as a subclass of `Energy`. Its methods
define how the energy is commanded, ramped, checked, bounded, refined, drawn and measured. Every method has a safe
default, which also serves a bare function. The scene, the solver, error estimates and pictures call these methods and
know no kind of energy by name, so a new kind of physics is one file.
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
from jaxbeam.mesh.refinement import Finer
from jaxbeam.physics.projection import project_each


class NotRefinable(ValueError):
    """Raised by `Energy.refined` if the term cannot be carried to a finer mesh. The text says why."""


class Energy:
    """The energy of one stencil: a function, with attributes and methods that describe it to the rest of the package.

    Make a subclass a frozen dataclass of functions and numbers. It is hashed, and each new value compiles again, so
    parameters that change belong in `params`. In `__call__`, `x` and `params` are the positions and parameters of a
    single stencil. In the other methods below, `x` `(m, k, d)` holds the positions of the nodes of `m` stencils, and
    `params` their parameters with leading axis `m`.
    """

    name: ClassVar[str] = "term"  # word for a stencil in pictures and messages
    body: ClassVar[bool] = False  # elastic material: the energy is a strain energy, unchanged by rigid motions
    fills: ClassVar[bool] = False  # the stencils are elements of area, whose outer edges are the surface of the body
    pointwise: ClassVar[bool] = False  # pushes single nodes, where displacements grow without end under refinement
    holds: tuple[bool, ...] = ()  # coordinates of its nodes that a support holds, `(d,)`; none of any other energy
    coordinates: ClassVar[int | None] = None  # number `d` that a node must have: 2, or 3 on a rod; None: any
    rest_command: ClassVar[float | None] = None  # command at which the term does nothing; None: it has no command
    shared_command: bool = False  # all stencils of a term share one command, instead of one for each
    commands: ClassVar[checks.Range] = checks.FINITE  # range of the commands
    command_unit: ClassVar[float | None] = None  # unit for changes of the command; None: the width of its bounds
    command_hint: ClassVar[str] = ""  # meaning of a command, for the message about a command out of range

    def __call__(self, x: jax.Array, params: Any) -> jax.Array:
        """Energy `()` of one stencil at positions `x` `(k, d)`."""
        raise NotImplementedError

    # ------------------------------------------------------------------------------------ derivatives

    def gradients(self, x: jax.Array, params: Any) -> tuple[jax.Array, jax.Array]:
        """Energies `(m,)` and their gradients `(m, k, d)`, by autodiff. Override it where there is a faster way."""
        return jax.vmap(jax.value_and_grad(self))(x, params)

    def hessians(self, x: jax.Array, params: Any, convex: bool = False) -> jax.Array:
        """Hessians `(k d, k d, m)`, by autodiff; if `convex`, projected to the nearest positive semidefinite ones."""
        m, k, d = x.shape
        of_one = lambda flat, params: self(flat.reshape(k, d), params)
        hessians = jax.vmap(jax.hessian(of_one))(x.reshape(m, k * d), params)
        return jnp.moveaxis(project_each(hessians) if convex else hessians, 0, -1)

    # -------------------------------------------------------------------------------------- actuation

    def command(self, params: Any, values: jax.Array) -> Any:
        """The parameters with the commands set to `values`: `(m,)`, or `(1,)` if the stencils share one command."""
        return params

    def command_of(self, params: Any) -> jax.Array:
        """The commands `(m,)` or `(1,)` that the parameters hold: the inverse of `command`."""
        raise NotImplementedError

    def partway(self, params: Any, share: jax.Array) -> Any:
        """The parameters with the fraction `share` `()` of the actuation or the load: none at 0, all at 1."""
        if self.rest_command is None:
            return params
        return self.command(params, (1 - share) * self.rest_command + share * self.command_of(params))

    def displacements(self, params: Any) -> jax.Array:
        """Displacements `(m, k, d)` that a support prescribes; zero for coordinates that it does not hold."""
        raise NotImplementedError

    def stride(self, params: Any) -> jax.Array | None:
        """The largest change of a command, `()`, from one solved state to the next; None: any."""
        return None

    # ----------------------------------------------------------------------------- ranges and bounds

    def valid(self, params: Any) -> Any:
        """Whether traced parameters are in their range, `()`. That they are finite is checked for every term."""
        return True

    def objection(self, term: Term, fixed: np.ndarray) -> str:
        """Why the term cannot act in a scene whose coordinates `fixed` `(n, d)` do not move; empty if it can."""
        return ""

    def margin(self, x: jax.Array, params: Any) -> jax.Array | None:
        """A quantity `(m,)` that must stay positive, such as the smallest `J` of an element; None: there is none."""
        return None

    def surrounded(self, x: jax.Array, points: jax.Array, params: Any) -> jax.Array | None:
        """Whether, `()`, the body has closed around what the stencils touch; None: never.

        Args:
            x: `(m, k, d)` positions of their nodes.
            points: `(p, 2)` points within the body.
            params: their parameters.
        """
        return None

    def longest_step(self, x: jax.Array, dx: jax.Array, params: Any, keep: float) -> jax.Array | None:
        """The largest `t` `(m,)` for which `x + t dx` keeps the fraction `keep` of the margin; None: no limit."""
        return None

    # ------------------------------------------------------------------------------------- refinement

    def refined(self, term: Term, mesh: Mesh, finer: Finer) -> Term:
        """The term on a finer mesh, on which nodes keep their numbers.

        Args:
            term: the term to carry over.
            mesh: the finer mesh.
            finer: how its elements and nodes come from those of the present mesh.

        Raises:
            NotRefinable: if the energy does not define it. A scene with such a term has no error bar.
        """
        raise NotRefinable("it does not say what it becomes on a finer mesh (see Energy.refined)")

    def without_limit(self, term: Term, mesh: Mesh, free: np.ndarray) -> str:
        """Why no error of the answer can be told from this mesh, such as a point load; empty if it can.

        Args:
            term: the term.
            mesh: of the scene, with concrete nodes.
            free: `(n,)` whether a node moves.
        """
        return ""

    def resolution(self, term: Term, mesh: Mesh, free: np.ndarray) -> dict[int, float]:
        """Of each patch of surface that it acts on, by its node: the width over the distance of nodes there. Arguments
        as of `without_limit`."""
        return {}

    # -------------------------------------------------------------------------- measures and pictures

    def measured(self, x: jax.Array, params: Any) -> dict[str, jax.Array]:
        """Measured quantities `(m,)` of the stencils, by name, such as `length` and `tension` of tendons."""
        return {}

    def at_points(self, x: jax.Array, params: Any, measure: Callable[..., jax.Array]) -> jax.Array | None:
        """`measure(H, density, material)` at the quadrature points, `(m, q, ...)`; None: there are no such points."""
        return None

    def sides(self, x: jax.Array, params: Any) -> list[jax.Array]:
        """Segments that bound a body without elements of area: `(m, 2, 2)` for each of its sides, as of a rod."""
        return []

    def line(self, x: jax.Array, params: Any) -> jax.Array | None:
        """Points `(m, p, 2)` of a line to draw for each stencil, in a colour of its own; None: it is not drawn."""
        return None

    def line_forces(self, x: jax.Array, params: Any) -> jax.Array | None:
        """Forces `(m, p, 2)` on the body at the points of the line; None if it has no line that pulls."""
        return None

    def arms(self, x: jax.Array, params: Any) -> jax.Array | None:
        """Segments `(m, p, 2, 2)` to draw from the body to points of `line` that are not nodes; None: none."""
        return None

    def anchors(self, params: Any) -> tuple[np.ndarray, np.ndarray] | None:
        """Nodes `(m, p)` and widths `(m, p)` of the patches of surface that it pulls on, to draw; None: none."""
        return None

    def point_loads(self, x: jax.Array, params: Any) -> jax.Array | None:
        """Outer forces to draw as arrows, `(q, 2, 2)`: for each the point where it acts, and the force; None: none."""
        return None

    def edge_loads(self, x: jax.Array, params: Any, xi: np.ndarray) -> jax.Array | None:
        """Outer forces to draw as rows of arrows along edges of the surface; None: none.

        Args:
            x: of stencils that are edges: the two ends, with the body on the left, then the node between if any.
            params: as above.
            xi: `(m,)` one point on each edge, from 0 at its first end to 1.

        Returns:
            Force per length `(m, 2)` at these points.
        """
        return None

    def obstacle(self, points: jax.Array, params: Any) -> jax.Array | None:
        """Distance `(q,)` of points `(q, 2)` from a rigid obstacle to draw, negative inside it; None: there is none."""
        return None

    def springs(self, params: Any) -> jax.Array | None:
        """Points `(m, 2)` to which springs tie the first node of each stencil, to draw; None: there are none."""
        return None


@dataclasses.dataclass(frozen=True)
class BareFunction(Energy):
    """A function `(x, params) -> scalar` as an energy with the defaults of `Energy`."""

    function: Callable[[jax.Array, Any], jax.Array]

    def __call__(self, x: jax.Array, params: Any) -> jax.Array:
        return self.function(x, params)


@pytree
class Term:
    """`m` stencils that share one energy function.

    Args:
        energy: an `Energy`, or a pure function `(x, params) -> scalar` of one stencil. `x` `(k, d)` are the positions
            of its nodes, with `d` 2, or 3 on a rod, and `params` are its parameters. Define the function at module
            level: a new lambda for every scene would compile again each time.
        nodes: `(m, k)` node numbers.
        params: any pytree of arrays with leading axis `m`. All of it is differentiable. Values that change
            belong here. In a closure, each new value would compile again.

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
        """The energy as an `Energy`."""
        return self.energy if isinstance(self.energy, Energy) else BareFunction(self.energy)

    @property
    def command_count(self) -> int:
        """Number of commands that the term takes."""
        if self.kind.rest_command is None:
            return 0
        return 1 if self.kind.shared_command else len(self.nodes)


def check_nodes(name: str, mesh: Mesh, nodes: Numbers, ndim: int) -> np.ndarray:
    """`nodes` as a concrete array of valid node numbers with `ndim` axes.

    Raises:
        ValueError: if `nodes` is anything else. The message calls the argument `name`.
    """
    checks.instance("mesh", mesh, Mesh, "a scene has it as scene.mesh")
    return checks.node_numbers(name, mesh.nodes.shape[0], nodes, ndim)
