"""Terms of the energy: one stencil's pure energy, the nodes it acts on, and its parameters.

A `Term` is all the solver knows of physics. Forces, stencil Hessians, their projection, assembly, the
derivative through equilibrium and the batch axis follow from its three fields. A term's force on the body
is minus the gradient of its energy; a tendon's tension is positive when it pulls its ends together.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam import checks
from jaxbeam._tree import (
    Numbers,
    index_field,
    is_concrete,
    namespace,
    pytree,
    read_only,
    static_field,
    to_device,
    usual_rules,
)
from jaxbeam.anchors import patch
from jaxbeam.elements import rule, shape_slopes
from jaxbeam.materials import check_density, macklin_mueller
from jaxbeam.mesh import Mesh, check_triangles


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


# ---------------------------------------------------------------------------------------------- solid


@pytree
class SolidParams:
    """Parameters of elements with `k` nodes and `q` quadrature points (leading axis `m` in a `Term`).

    rest `(m, k, 2)`: rest positions. gradients `(m, q, k, 2)`: shape-function gradients in the rest frame.
    weights `(m, q)`: quadrature weight times rest area. material: pytree with leading axis `m`.
    """

    rest: jax.Array
    gradients: jax.Array
    weights: jax.Array
    material: Any


@dataclasses.dataclass(frozen=True)
class SolidEnergy:
    """Energy of one element: the density summed over its quadrature points. Hashable, so never retraced."""

    density: Callable[[jax.Array, Any], jax.Array]

    def __call__(self, x: jax.Array, params: SolidParams) -> jax.Array:
        densities = jax.vmap(lambda H: self.density(H, params.material))(displacement_gradients(x, params))
        return jnp.sum(params.weights * densities)


def forbids_inversion(energy: SolidEnergy, params: SolidParams) -> bool:
    """Whether the density is infinite or undefined for an inverted element, as a logarithmic one is."""
    ones = jax.tree.map(lambda leaf: np.ones(leaf.shape[1:], leaf.dtype), params.material)
    inverted = np.array([[-1.5, 0.0], [0.0, 0.0]], params.rest.dtype)
    # That it may be NaN is what is asked.
    with jax.ensure_compile_time_eval(), jax.debug_nans(False):
        return not np.isfinite(jax.jit(energy.density)(inverted, ones))


def displacement_gradients(x: jax.Array, params: SolidParams) -> jax.Array:
    """`H = F - I` `(q, 2, 2)` of one element at its quadrature points."""
    return jnp.einsum("ki,qkj->qij", x - params.rest, params.gradients)


@usual_rules
def solid(
    mesh: Mesh,
    params: Any,
    density: Callable[[jax.Array, Any], jax.Array] = macklin_mueller,
    degree: int | None = None,
) -> Term:
    """The body itself.

    Args:
        mesh: with nodes `(n, 2)`; differentiable in them.
        params: the density's parameters, such as `lame(young, poisson)`: a pytree whose leaves are scalars
            or have leading axis `t`, one entry for each triangle. Cast to the dtype of the nodes.
        density: `(H, params) -> scalar`, one of `jaxbeam.materials` or your own module-level function.
        degree: of the polynomials in the density that the quadrature takes exactly, of `jaxbeam.elements.DEGREES`. By
            default 1 (one point) for triangles of three nodes, where that is exact for any density, and 2 (three
            points) for six.

    Raises:
        ValueError: if a parameter is neither a scalar nor of leading axis `t` or is not finite, there is no rule of
            that degree, or the density returns no scalar or is not that of `H = F - I`.
    """
    check_triangles(mesh)
    total, dtype = mesh.elements.shape[0], mesh.nodes.dtype
    xp = namespace(mesh.nodes, *jax.tree.leaves(params))

    def per_element(path: Any, value: Numbers) -> jax.Array:
        name = f"params{jax.tree_util.keystr(path)}"
        array = xp.asarray(checks.numbers(name, value), dtype)
        if array.ndim == 0:
            return xp.full((total,), array)
        if array.shape[0] != total:
            raise ValueError(
                f"{name}: expected a scalar or {total} entries, one for each triangle, got shape {array.shape}"
            )
        return array

    material = jax.tree_util.tree_map_with_path(per_element, params)
    check_density(density, material)
    rest = xp.asarray(mesh.nodes)[mesh.elements]
    usual = 1 if rest.shape[1] == 3 else 2
    points, shares = rule(usual if degree is None else checks.count("degree", degree, 1))
    # How a triangle is mapped from the reference one, and the inverse of that, at each point.
    slopes = xp.asarray(shape_slopes(rest.shape[1], points), dtype)
    map_ = xp.einsum("mkd,qki->mqdi", rest, slopes)
    determinant = map_[..., 0, 0] * map_[..., 1, 1] - map_[..., 0, 1] * map_[..., 1, 0]
    inverse = xp.stack([map_[..., 1, 1], -map_[..., 0, 1], -map_[..., 1, 0], map_[..., 0, 0]], axis=-1)
    inverse = inverse.reshape(map_.shape) / determinant[..., None, None]
    gradients = xp.einsum("qki,mqid->mqkd", slopes, inverse)
    weights = 0.5 * xp.asarray(shares, dtype) * determinant
    return Term(SolidEnergy(density), mesh.elements, SolidParams(rest, gradients, weights, material))


# -------------------------------------------------------------------------------------------- tendons


@pytree
class TendonParams:
    """Parameters of tendons (leading axis `m` in a `Term`), all differentiable but the last two.

    natural: length at rest (ratio 1). commanded: rest length asked for now, `ratio * natural`.
    modulus: the coefficient of the tendon's stiffness law.
    attachment: what the energy's `points` needs to know; none for tendons fixed to nodes.
    ends, width `(m, k)`: the node and the width of each anchor, if there are any of finite width.
    """

    natural: jax.Array
    commanded: jax.Array
    modulus: jax.Array
    attachment: Any = None
    width: Any = None
    ends: Any = index_field(default=None)


def inverse_square_stiffness(modulus: jax.Array, commanded: jax.Array) -> jax.Array:
    """`k = modulus / commanded^2`: the reference law. It grows as the tendon is shortened."""
    return modulus / commanded**2


def inverse_stiffness(modulus: jax.Array, commanded: jax.Array) -> jax.Array:
    """`k = EA / commanded`: an elastic thread of axial stiffness `EA = modulus`, wound in at its end."""
    return modulus / commanded


def constant_stiffness(modulus: jax.Array, commanded: jax.Array) -> jax.Array:
    """`k = modulus`: a spring whose stiffness does not depend on the command."""
    return modulus


_LAWS = (inverse_square_stiffness, inverse_stiffness, constant_stiffness)


def check_law(stiffness: Callable[[jax.Array, jax.Array], jax.Array]) -> None:
    """Refuse what is not a law of stiffness, a function of two numbers that returns one."""
    form = "(modulus, commanded) -> k, such as inverse_square_stiffness"
    checks.function("stiffness", stiffness, form)
    if stiffness not in _LAWS:
        checks.scalar("stiffness", form, stiffness, *2 * [jax.ShapeDtypeStruct((), jnp.result_type(float))])


def at_nodes(x: jax.Array, attachment: None) -> jax.Array:
    """The points `(k, 2)` of a tendon that is fixed to its `k` nodes."""
    return x


def at_means(x: jax.Array, attachment: jax.Array) -> jax.Array:
    """The points `(p, 2)` of a tendon that are weighted means, by weights `(p, k)`, of its `k` nodes."""
    return jnp.sum(attachment[:, :, None] * x, axis=1)


@dataclasses.dataclass(frozen=True)
class TendonEnergy:
    """`1/2 k (l - l*)^2` of one two-way tendon: `l` the length of the line through its points, `l*` the
    commanded length, `k = stiffness(modulus, l*)`. Longer than its ends are apart, it pushes."""

    stiffness: Callable[[jax.Array, jax.Array], jax.Array]
    points: Callable[[jax.Array, Any], jax.Array] = at_nodes

    def __call__(self, x: jax.Array, params: TendonParams) -> jax.Array:
        stretch = self.length(x, params) - params.commanded
        return 0.5 * self.stiffness(params.modulus, params.commanded) * stretch**2

    def length(self, x: jax.Array, params: TendonParams) -> jax.Array:
        """Present length `l`."""
        return polyline_length(self.points(x, params.attachment))

    def tension(self, x: jax.Array, params: TendonParams) -> jax.Array:
        """`dE/dl = k (l - l*)`, positive when it pulls."""
        return self.stiffness(params.modulus, params.commanded) * (self.length(x, params) - params.commanded)


def polyline_length(x: jax.Array) -> jax.Array:
    """Length `(...)` of the line through the points `x` `(..., k, 2)`.

    Where two neighbours meet the length has no derivative; there it and every higher one is zero, not NaN.
    """
    xp = namespace(x)
    squared = xp.sum((x[..., 1:, :] - x[..., :-1, :]) ** 2, axis=-1)
    apart = squared > 0
    return xp.sum(xp.where(apart, xp.sqrt(xp.where(apart, squared, 1)), 0), axis=-1)


@usual_rules
def tendons(
    mesh: Mesh,
    nodes: Numbers,
    modulus: Numbers,
    stiffness: Callable[[jax.Array, jax.Array], jax.Array] = inverse_square_stiffness,
    width: Numbers = 0.0,
) -> Term:
    """Tendons fixed to nodes of the mesh, at their natural length (ratio 1); `command` shortens them.

    Args:
        mesh: natural lengths are measured on its rest positions, and differentiable in them.
        nodes: `(m, k)` node numbers: the two ends of each tendon, with any guides between.
        modulus: coefficient of the stiffness law, positive; scalar or `(m,)`.
        stiffness: the law `(modulus, commanded) -> k`, such as `inverse_square_stiffness` (of the reference
            scene; unit of modulus: force x length), `inverse_stiffness` (force) or `constant_stiffness`
            (force / length). Tendons of another law are another term.
        width: of the patch of surface that each node stands for (see `jaxbeam.anchors`), scalar or `(m, k)`. At 0 the
            tendon pulls on the node alone: a point load, whose answer has no limit as the mesh is refined.

    Raises:
        ValueError: if a node is out of range, a tendon repeats a node, has no length or fewer than two
            nodes, a concrete modulus is not positive and finite, a width is negative, or as `patch` does.
    """
    check_law(stiffness)
    lines = check_nodes("nodes", mesh, nodes, ndim=2)
    if lines.shape[1] < 2:
        raise ValueError(f"nodes: expected at least two nodes for each tendon, got shape {lines.shape}")
    ordered = np.sort(lines, axis=1)
    if (np.diff(ordered, axis=1) == 0).any():
        k = int(np.flatnonzero((np.diff(ordered, axis=1) == 0).any(axis=1))[0])
        raise ValueError(f"nodes: tendon {k} repeats a node: {lines[k].tolist()}; give each of its points once")
    modulus = checks.numbers("modulus", modulus, checks.POSITIVE, ((), lines.shape[:1]))
    if not is_concrete(width):
        raise ValueError("width: expected known numbers, got traced ones; the nodes of a patch depend on its width")
    tents = checks.numbers("width", width, checks.NOT_NEGATIVE, ((), lines.shape))
    widths = np.broadcast_to(tents.astype(float), lines.shape)
    dtype, rest = mesh.nodes.dtype, namespace(mesh.nodes).asarray(mesh.nodes)
    anchored: tuple[np.ndarray, ...] = ()
    if not widths.any():
        nodes_of, energy = lines, TendonEnergy(stiffness)
        natural = polyline_length(rest[lines])
    else:
        nodes_of, weights = _means(mesh, lines, widths)
        energy, anchored = TendonEnergy(stiffness, at_means), (weights.astype(dtype), widths.astype(dtype), lines)
        natural = polyline_length(np.einsum("mpk,mkd->mpd", weights, np.asarray(rest)[nodes_of]).astype(dtype))
    xp = namespace(modulus)
    moduli = xp.broadcast_to(xp.asarray(modulus, dtype), natural.shape)
    return Term(energy, nodes_of, TendonParams(natural, natural, moduli, *anchored))


def _means(mesh: Mesh, lines: np.ndarray, widths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nodes `(m, k)` of the patches of each tendon, and the weights `(m, p, k)` of its `p` points."""
    found = [
        [patch(mesh, int(node), float(width)) for node, width in zip(*pair, strict=True)]
        for pair in zip(lines, widths, strict=True)
    ]
    unions = [np.unique(np.concatenate([nodes for nodes, _ in line])) for line in found]
    most = max(len(union) for union in unions)
    # Filled up with the last node, at weight 0.
    nodes = np.stack([np.append(union, np.full(most - len(union), union[-1])) for union in unions])
    weights = np.zeros((*lines.shape, most))
    for k, line in enumerate(found):
        for p, (members, values) in enumerate(line):
            weights[k, p, np.searchsorted(unions[k], members)] = values
    return nodes, weights


# ---------------------------------------------------------------------------------- loads and springs


@pytree
class PointParams:
    """Rest position `(m, 2)` and a vector or scalar `value` for each loaded node."""

    rest: jax.Array
    value: jax.Array


def dead_load_energy(x: jax.Array, params: PointParams) -> jax.Array:
    """`-f . (x - X)`: a force of constant size and direction on one node."""
    return -jnp.sum(params.value * (x[0] - params.rest))


def penalty_energy(x: jax.Array, params: PointParams) -> jax.Array:
    """`1/2 k |x - X|^2`: a spring from one node to its rest position."""
    return 0.5 * params.value * jnp.sum((x[0] - params.rest) ** 2)


@usual_rules
def dead_load(mesh: Mesh, nodes: Numbers, force: Numbers) -> Term:
    """Constant forces on nodes.

    Args:
        mesh: its rest positions are the zero of the load's energy.
        nodes: `(m,)` node numbers.
        force: `(2,)` on each of them, or `(m, 2)`; on a rod `(3,)` or `(m, 3)`, the third a moment over `radian`
            (see `jaxbeam.rod`); differentiable.

    Raises:
        ValueError: if a node is out of range or `force` has another shape or is not finite.
    """
    where = check_nodes("nodes", mesh, nodes, ndim=1)
    d = mesh.nodes.shape[1]
    force = checks.numbers("force", force, shapes=((d,), (where.size, d)))
    xp, rest = namespace(force), namespace(mesh.nodes).asarray(mesh.nodes)[where]
    values = xp.broadcast_to(xp.asarray(force, mesh.nodes.dtype), (where.size, d))
    return Term(dead_load_energy, where[:, None], PointParams(rest, values))


@usual_rules
def penalty_springs(mesh: Mesh, nodes: Numbers, stiffness: Numbers) -> Term:
    """Springs that hold nodes near their rest positions: a soft clamp.

    A clamp in `Scene.fixed` is exact and cheaper. This one, at the usual 1e9, shifts the reference angle
    by 2e-6 degrees and rules out float32; it is here for comparison with codes that clamp so.

    Args:
        mesh: gives the rest positions.
        nodes: `(m,)` node numbers.
        stiffness: force per length, not negative; scalar or `(m,)`; differentiable.

    Raises:
        ValueError: if a node is out of range, or `stiffness` has another shape or is negative or not finite.
    """
    where = check_nodes("nodes", mesh, nodes, ndim=1)
    stiffness = checks.numbers("stiffness", stiffness, checks.NOT_NEGATIVE, ((), (where.size,)))
    xp, rest = namespace(stiffness), namespace(mesh.nodes).asarray(mesh.nodes)[where]
    values = xp.broadcast_to(xp.asarray(stiffness, mesh.nodes.dtype), (where.size,))
    return Term(penalty_energy, where[:, None], PointParams(rest, values))


def check_nodes(name: str, mesh: Mesh, nodes: Numbers, ndim: int) -> np.ndarray:
    """`nodes` as a concrete array of valid node numbers with `ndim` axes, or a `ValueError` that names it."""
    checks.instance("mesh", mesh, Mesh, "a scene has it as scene.mesh")
    return checks.node_numbers(name, mesh.nodes.shape[0], nodes, ndim)
