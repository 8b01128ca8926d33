"""Tendons: springs along a line through points of a body, commanded by their rest length.

A tendon's tension is positive if it pulls its ends together. These tendons are two-way: a tendon whose commanded length
exceeds the length of its line pushes. `cables` only pull.

The law of stiffness is a choice. `inverse_square_stiffness` is that of the reference scene. `inverse_stiffness` is that
of an elastic thread of which a part is wound in, and `constant_stiffness` that of a spring behind a stiff thread.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers, index_field, is_concrete, namespace, pytree, replace, to_device
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.mesh.refinement import Finer
from jaxbeam.mesh.surface import node_spacing, patch
from jaxbeam.physics.energy import Energy, Term, check_nodes

# An anchor whose width is below this share of the distance of the nodes beside it is a point load to the mesh.
NARROW = 0.1

# -------------------------------------------------------------------------------------------- tendons


@pytree
class TendonParams:
    """Parameters of `m` tendons, all differentiable except `width` and `ends`.

    natural: `(m,)` length of the tendon when the body is at rest (ratio 1).
    commanded: `(m,)` commanded rest length, `ratio * natural`.
    modulus: `(m,)` coefficient of the stiffness law.
    attachment: argument of the energy's function `points`, leading axis `m`; None for tendons fixed to nodes.
    width: `(m, p)` width of each anchor; None if no anchor has a finite width.
    ends: `(m, p)` node of each anchor; None if no anchor has a finite width.
    """

    natural: jax.Array
    commanded: jax.Array
    modulus: jax.Array
    attachment: Any = None
    width: Any = None
    ends: Any = index_field(default=None)


def inverse_square_stiffness(modulus: jax.Array, commanded: jax.Array) -> jax.Array:
    """`k = modulus / commanded^2`: the law of the reference scene. The stiffness grows as the tendon is shortened."""
    return modulus / commanded**2


def inverse_stiffness(modulus: jax.Array, commanded: jax.Array) -> jax.Array:
    """`k = EA / commanded`: an elastic thread of axial stiffness `EA = modulus`, wound in at its end."""
    return modulus / commanded


def constant_stiffness(modulus: jax.Array, commanded: jax.Array) -> jax.Array:
    """`k = modulus`: a spring whose stiffness does not depend on the command."""
    return modulus


_LAWS = (inverse_square_stiffness, inverse_stiffness, constant_stiffness)


def check_law(stiffness: Callable[[jax.Array, jax.Array], jax.Array]) -> None:
    """Raise `ValueError` if `stiffness` is not a function of two numbers that returns one number."""
    form = "(modulus, commanded) -> k, such as inverse_square_stiffness"
    checks.function("stiffness", stiffness, form)
    if stiffness not in _LAWS:
        checks.scalar("stiffness", form, stiffness, *2 * [jax.ShapeDtypeStruct((), jnp.result_type(float))])


def at_nodes(x: jax.Array, attachment: None) -> jax.Array:
    """The points `(k, 2)` of a tendon that is fixed to its `k` nodes."""
    return x


def at_means(x: jax.Array, attachment: jax.Array) -> jax.Array:
    """The points `(p, 2)` of a tendon as means of its `k` nodes, with weights `attachment` `(p, k)`."""
    return jnp.sum(attachment[:, :, None] * x, axis=1)


class LineEnergy(Energy):
    """What all energies of a line through points of a body have in common: tendons, cables, and those of a user.

    A subclass is a frozen dataclass with the field `points`, and says what its `tension` is. Its parameters have the
    fields `attachment`, `width` and `ends`, as in `TendonParams`.

    points: from the nodes `x` of the line and its `attachment`, the points that it runs through.
    """

    points: Callable[[jax.Array, Any], jax.Array]
    shared_command: bool
    coordinates: ClassVar[int | None] = 2

    def length(self, x: jax.Array, params: Any) -> jax.Array:
        """Present length `l` `()`."""
        return polyline_length(self.points(from_first(x), params.attachment))

    def tension(self, x: jax.Array, params: Any) -> jax.Array:
        """Tension `dE/dl` `()`, the same along the whole line; positive if it pulls."""
        raise NotImplementedError

    def without_limit(self, term: Term, mesh: Mesh, free: np.ndarray) -> str:
        found = self.resolution(term, mesh, free)
        node = min(found, key=found.__getitem__, default=-1)
        if node < 0 or found[node] >= NARROW:
            return ""
        if found[node] == 0:
            return "a tendon pulls on a single node, where displacements grow without end; give its anchor a width"
        spacing = node_spacing(mesh, node)
        width = found[node] * spacing
        return (
            f"the anchor of width {width:.3g} at node {node} is too narrow for surface nodes at distances of "
            f"{spacing:.3g}; use a mesh with nodes at most {width / NARROW:.3g} apart there, or a wider anchor"
        )

    def resolution(self, term: Term, mesh: Mesh, free: np.ndarray) -> dict[int, float]:
        ends, widths = term.nodes, np.zeros(term.nodes.shape)
        if term.params.width is not None:
            ends, widths = np.asarray(term.params.ends), np.asarray(term.params.width)
        found: dict[int, float] = {}
        for node, width in zip(ends[free[ends]].tolist(), widths[free[ends]].tolist(), strict=True):
            share = width / node_spacing(mesh, node) if width else 0.0
            found[node] = min(share, found.get(node, np.inf))
        return found

    def measured(self, x: jax.Array, params: Any) -> dict[str, jax.Array]:
        return {"length": jax.vmap(self.length)(x, params), "tension": jax.vmap(self.tension)(x, params)}

    def line_forces(self, x: jax.Array, params: Any) -> jax.Array:
        def of_one(x: jax.Array, params: Any) -> jax.Array:
            points = self.points(from_first(x), params.attachment)
            return -self.tension(x, params) * jax.grad(polyline_length)(points)

        return jax.vmap(of_one)(x, params)

    def line(self, x: jax.Array, params: Any) -> jax.Array:
        return jax.vmap(self.points)(x, params.attachment)[..., :2]

    def anchors(self, params: Any) -> tuple[np.ndarray, np.ndarray] | None:
        return None if params.ends is None else (params.ends, np.asarray(params.width))


@dataclasses.dataclass(frozen=True)
class TendonEnergy(LineEnergy):
    """Energy of one two-way tendon, `1/2 k (l - l*)^2` with `k = stiffness(modulus, l*)`.

    `l` is the length of the line through its points, and `l*` the commanded length. The command is the ratio of `l*` to
    the natural length.

    stiffness: the law `(modulus, commanded) -> k`.
    points: from the nodes `x` of the tendon and its `attachment`, the points of its line.
    shared_command: whether one ratio commands all tendons of the term.
    """

    stiffness: Callable[[jax.Array, jax.Array], jax.Array]
    points: Callable[[jax.Array, Any], jax.Array] = at_nodes
    shared_command: bool = False
    name: ClassVar[str] = "tendon"
    rest_command: ClassVar[float | None] = 1.0
    commands: ClassVar[checks.Range] = checks.POSITIVE
    command_unit: ClassVar[float | None] = 1.0
    command_hint: ClassVar[str] = "1 is the natural length and 0.5 half of it"

    def __call__(self, x: jax.Array, params: TendonParams) -> jax.Array:
        stretch = self.length(x, params) - params.commanded
        return 0.5 * self.stiffness(params.modulus, params.commanded) * stretch**2

    def tension(self, x: jax.Array, params: TendonParams) -> jax.Array:
        """Tension `dE/dl = k (l - l*)` `()`, positive if the tendon pulls."""
        return self.stiffness(params.modulus, params.commanded) * (self.length(x, params) - params.commanded)

    def command(self, params: TendonParams, values: jax.Array) -> TendonParams:
        natural = params.natural
        commanded = namespace(values, natural).asarray(values, natural.dtype) * namespace(natural).asarray(natural)
        return replace(params, commanded=to_device(commanded))

    def command_of(self, params: TendonParams) -> jax.Array:
        ratios = params.commanded / params.natural
        return ratios[:1] if self.shared_command else ratios

    def partway(self, params: TendonParams, share: jax.Array) -> TendonParams:
        return replace(params, commanded=(1 - share) * params.natural + share * params.commanded)

    def valid(self, params: TendonParams) -> jax.Array:
        return jnp.all((params.commanded > 0) & (params.modulus > 0))

    def refined(self, term: Term, mesh: Mesh, finer: Finer) -> Term:
        params = term.params
        if params.width is None:
            return term
        width = np.asarray(params.width)
        new = tendons(mesh, without_filling(params.ends), params.modulus, self.stiffness, width, self.shared_command)
        params = replace(new.params, natural=params.natural, commanded=params.commanded)
        return Term(self, new.nodes, params)


def from_first(x: Any) -> Any:
    """Coordinates `(..., k, d)` of nodes, with positions relative to the first node and angles as they are.

    Points beside nodes, and means of nodes, would lose digits if they were computed far from the origin.
    """
    return x - x[..., :1, :] * np.array([1.0, 1.0, 0.0], x.dtype)[: x.shape[-1]]


def polyline_length(x: jax.Array) -> jax.Array:
    """Length `(...)` of the line through the points `x` `(..., k, 2)`.

    A segment of zero length has no derivative. Its derivatives of all orders are set to zero here, instead of NaN.
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
    shared: bool = False,
    natural: Numbers | None = None,
) -> Term:
    """Tendons fixed to nodes of the mesh, at their natural length (ratio 1); `command` shortens them.

    They are two-way springs: one that is longer than its ends are apart pushes. At ratios (1.2, 1) the top tendon of
    the reference scene pushes with 125. `cables` only pull.

    Between its ends a tendon slides, so its tension is the same along its whole length. A tendon that is glued to the
    body is a row for each segment between two neighbouring nodes, with `shared=True`: each segment has its own tension,
    and one command shortens them all.

    Args:
        mesh: its rest positions determine the natural lengths, which are differentiable in them.
        nodes: for each tendon the numbers of its nodes: its first end, any guides, through which it slides, and its
            second end. `(m, k)`, or a list of rows of different lengths.
        modulus: coefficient of the stiffness law, positive; scalar or `(m,)`.
        stiffness: the law `(modulus, commanded) -> k`, such as `inverse_square_stiffness` (of the reference
            scene; unit of modulus: force x length), `inverse_stiffness` (force) or `constant_stiffness`
            (force / length). Tendons with another law need a term of their own.
        width: width of the patch of surface that each node stands for (see `jaxbeam.mesh.surface`); scalar or `(m, k)`.
            At 0 the tendon pulls on the node alone. This is a point load: its answer has no limit as the mesh is
            refined.
        shared: whether one ratio commands all of them, in place of one each.
        natural: natural length, of which ratios are; positive; scalar or `(m,)`; differentiable. By default the length
            at rest. With another one the tendon pulls, or pushes, at ratio 1 too.

    Raises:
        ValueError: if a node is out of range, a tendon repeats a node, has no length or fewer than two
            nodes, a concrete modulus or natural length is not positive and finite, a width is negative, or as
            `patch` does.
    """
    check_law(stiffness)
    checks.flag("shared", shared)
    lines = check_lines(mesh, nodes)
    modulus = checks.numbers("modulus", modulus, checks.POSITIVE, ((), lines.shape[:1]))
    if not is_concrete(width):
        raise ValueError("width: expected known numbers, got traced ones; the nodes of a patch depend on its width")
    tents = checks.numbers("width", width, checks.NOT_NEGATIVE, ((), lines.shape))
    widths = np.broadcast_to(tents.astype(float), lines.shape)
    dtype, rest = mesh.nodes.dtype, namespace(mesh.nodes).asarray(mesh.nodes)
    anchored: tuple[np.ndarray, ...] = ()
    if not widths.any():
        nodes_of, energy = lines, TendonEnergy(stiffness, at_nodes, shared)
        lengths = polyline_length(rest[lines])
    else:
        nodes_of, weights = _patch_means(mesh, lines, widths)
        energy = TendonEnergy(stiffness, at_means, shared)
        anchored = (weights.astype(dtype), widths.astype(dtype), lines)
        places = from_first(np.asarray(rest)[nodes_of])
        lengths = polyline_length(np.einsum("mpk,mkd->mpd", weights, places).astype(dtype))
    if natural is not None:
        given = checks.numbers("natural", natural, checks.POSITIVE, ((), lines.shape[:1]), "one for each tendon")
        xp = namespace(given)
        lengths = xp.broadcast_to(xp.asarray(given, dtype), lines.shape[:1])
    xp = namespace(modulus)
    moduli = xp.broadcast_to(xp.asarray(modulus, dtype), lengths.shape)
    return Term(energy, nodes_of, TendonParams(lengths, lengths, moduli, *anchored))


def check_lines(mesh: Mesh, nodes: Any) -> np.ndarray:
    """Nodes `(m, k)` of lines. Shorter rows of a list are filled up with their last node, which adds no length."""
    ragged = isinstance(nodes, list | tuple) and len({np.size(row) for row in nodes}) > 1
    rows = [check_nodes(f"nodes[{k}]", mesh, row, ndim=1) for k, row in enumerate(nodes)] if ragged else []
    rows = rows or list(check_nodes("nodes", mesh, nodes, ndim=2))
    for k, row in enumerate(rows):
        if len(row) < 2:
            raise ValueError(f"nodes: expected at least two nodes for each tendon, got {row.tolist()} for tendon {k}")
        if len(np.unique(row)) < len(row):
            raise ValueError(f"nodes: tendon {k} repeats a node: {row.tolist()}; give each of its points once")
    most = max(len(row) for row in rows)
    return np.stack([np.append(row, np.full(most - len(row), row[-1])) for row in rows])


def without_filling(lines: np.ndarray) -> list[np.ndarray]:
    """The rows of lines `(m, k)` as they were given to `check_lines`."""
    return [row[: 1 + int(np.flatnonzero(row != row[-1])[-1]) + 1] for row in np.asarray(lines)]


def _patch_means(mesh: Mesh, lines: np.ndarray, widths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nodes `(m, k)` of all patches of each tendon, and their weights `(m, p, k)` in its `p` points.

    Args:
        mesh: with concrete nodes.
        lines: `(m, p)` node of each anchor.
        widths: `(m, p)` width of each anchor.
    """
    found = [
        [patch(mesh, int(node), float(width)) for node, width in zip(*pair, strict=True)]
        for pair in zip(lines, widths, strict=True)
    ]
    unions = [np.unique(np.concatenate([nodes for nodes, _ in line])) for line in found]
    most = max(len(union) for union in unions)
    # Tendons with fewer nodes are padded with their last node, at weight 0.
    nodes = np.stack([np.append(union, np.full(most - len(union), union[-1])) for union in unions])
    weights = np.zeros((*lines.shape, most))
    for k, line in enumerate(found):
        for p, (members, values) in enumerate(line):
            weights[k, p, np.searchsorted(unions[k], members)] = values
    return nodes, weights
