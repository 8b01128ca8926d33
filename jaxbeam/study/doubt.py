"""Why no bound of a discretisation error is known: what a change from one mesh to a finer one does not show.

Three reasons. Of each, the finer mesh changes the answer by little, and still finer ones by much.

1. A load acts on a point, or on an anchor that is narrow beside the elements. Displacements under it grow like the
   logarithm of the mesh. This is known from the scene alone (`scene_doubt`).
2. The measure reads displacements under a point load, or strains at a place where they are infinite: an end of a clamp,
   a re-entrant corner of the body (Williams 1952, J. Appl. Mech. 19, 526-528). Its derivative in the nodes there does
   not shrink from one mesh to the next (`reads`).
3. The compressed surface is near a crease: an instability of the surface without a length of its own, which coarse
   meshes do not show (`softest`).

For the third, each piece of the surface is compared with a half-space in the same state of strain. Displacements
`u exp(i k s)` along its surface meet the force `k Z u`, where the Hermitian matrix `Z`, the surface impedance, follows
from the moduli `A_iJkL = d2 psi / dF_iJ dF_kL`. With the unit vectors `m = (cos t, sin t)` and `n = (-sin t, cos t)` in
the tangent and the normal, and `T = n A n`, `R = m A n`, of which means over `t` are taken,

    H = mean(T^-1),     S = -mean(T^-1 R^T),     Z = H^-1 (1 + i S)

(Lothe and Barnett 1976, J. Appl. Phys. 47, 428-433). Where the smallest eigenvalue of `Z` reaches zero the surface
wrinkles: in an incompressible neo-Hookean solid at a stretch of 0.544 (Biot 1963, Appl. Sci. Res. A 12, 168-182). A
crease forms before, at 0.647 (Hohlfeld and Mahadevan 2011, Phys. Rev. Lett. 106, 105702), where the eigenvalue is 0.35
of that at rest.
"""

from __future__ import annotations

import enum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core.tree import index_field, pytree
from jaxbeam.mesh.elements import element_of
from jaxbeam.physics.energy import Term
from jaxbeam.scene.nodal import points_to_nodes
from jaxbeam.scene.scene import Scene

# Share of its stiffness at rest below which the surface may crease. Above it, coarse and fine meshes agreed in all
# scenes measured, of lengths 2 to 9 heights and Poisson's ratios 0.3 to 0.45, where nothing disturbs the surface.
SOFT = 0.2
# A measure reads a singular place if its derivative in a node there keeps the share `KEPT` of its size on the finer
# mesh, and has the share `PART` of the largest. A measure spread over a length or an area keeps 0.3 to 0.7.
KEPT = 0.8
PART = 0.05
STEEPER = 1.3
# Share below which a derivative is round-off.
NOISE = 1e-6
# Sine of the turn of the surface, here 20 degrees, beyond which a hollow is a re-entrant corner.
HOLLOW = 0.34
# Number of angles of the means of the surface impedance. Their error falls exponentially with it.
ANGLES = 32


class Doubt(enum.IntFlag):
    """Why no error bar is known, as flags that combine; `REASONS` has them in words.

    NONE: one is known.
    SCENE: a load acts on a point or on a very narrow anchor (see `scene_doubt`).
    ANCHOR: the measure reads strains at an anchor that is narrower than the distance of nodes.
    LOAD: the measure reads positions at a point load.
    CORNER: the measure reads strains where they are infinite.
    WORST: the measure is the worst value in the body.
    CREASE: the surface may crease.
    """

    NONE = 0
    SCENE = 1
    ANCHOR = 2
    LOAD = 4
    CORNER = 8
    WORST = 16
    CREASE = 32


REASONS = {
    Doubt.SCENE: "a load acts on a point, or on an anchor that is narrow beside the elements",
    Doubt.ANCHOR: "the measure reads strains at an anchor that is narrower than the distance of nodes there",
    Doubt.LOAD: "the measure reads positions at the node of a point load, where displacements grow without end",
    Doubt.CORNER: "the measure reads strains at an end of a clamp or a re-entrant corner, where they are infinite",
    Doubt.WORST: "the measure is the worst value in the body, and strains at corners and ends of clamps are infinite",
    Doubt.CREASE: "the surface may crease, and a finer mesh may give another answer",
}


@pytree
class Places:
    """Nodes of two meshes where an error bar may not be known; made by `places_of`.

    corners: `(n,)` of the coarser mesh, as booleans: see `corners`.
    finer_corners: `(N,)` of the finer mesh.
    beside: `(N,)` nodes of the finer mesh that lie in elements of the coarser one at its corners.
    narrow: `(n,)` anchors that are narrower than the distance of nodes beside them.
    """

    corners: np.ndarray = index_field()
    finer_corners: np.ndarray = index_field()
    beside: np.ndarray = index_field()
    narrow: np.ndarray = index_field()


def places_of(scene: Scene, finer: Scene) -> Places:
    """The places of a scene and of the same on a finer mesh. The nodes must be concrete."""
    narrow = np.zeros(len(scene.held), bool)
    narrow[[node for node, share in resolution(scene).items() if share < 1]] = True
    found, beside = corners(scene), np.zeros(len(finer.held), bool)
    at_corner = found[scene.mesh.elements].any(axis=1)
    beside[finer.mesh.elements.reshape(len(at_corner), -1)[at_corner]] = True
    return Places(found, corners(finer), beside, narrow)


def doubts(
    places: Places, scene: Scene, x: jax.Array, finer: Scene, slope: jax.Array, fine: jax.Array, other: jax.Array
) -> jax.Array:
    """Flags `()` of what a measure reads: `ANCHOR`, `LOAD`, `CORNER` and `WORST`.

    Args:
        places: of both meshes.
        scene: on the coarser mesh.
        x: `(n, 2)` its positions.
        finer: on the finer mesh, on which the nodes keep their numbers.
        slope: `(n, 2)` derivative of the measure in the positions.
        fine: `(N, 2)` on the finer mesh.
        other: `(N, 2)` on the finer mesh, at the `squashed` positions.
    """
    found = {
        Doubt.ANCHOR: reads_anchor(places, scene, finer, slope, fine),
        Doubt.LOAD: reads_load(scene, finer, x, slope, fine),
        Doubt.CORNER: reads_corner(places, scene, finer, slope, fine),
        Doubt.WORST: takes_worst(places.finer_corners, finer, fine, other),
    }
    return sum((jnp.where(raised, int(flag), 0) for flag, raised in found.items()), jnp.zeros((), jnp.int32))


def scene_doubt(scene: Scene) -> str:
    """Why no error of any measure of a scene can be told; empty if no term objects. The nodes must be concrete."""
    free = np.logical_not(scene.held.all(axis=1))
    reasons = (term.kind.without_limit(term, scene.mesh, free) for term in scene.terms)
    return next((reason for reason in reasons if reason), "")


def resolution(scene: Scene) -> dict[int, float]:
    """Of each anchor on a free node of a scene with concrete nodes: its width over the distance of nodes there."""
    free = np.logical_not(scene.held.all(axis=1))
    found: dict[int, float] = {}
    for term in scene.terms:
        for node, share in term.kind.resolution(term, scene.mesh, free).items():
            found[node] = min(share, found.get(node, np.inf))
    return found


def widening(scene: Scene) -> float:
    """Factor of the error bar for anchors that are narrower than the distance of nodes beside them; else 1.

    Until the nodes are as close as the anchor is wide, each halving of their distance changes the answer by about the
    same amount: displacements grow like the logarithm.
    """
    least = min(resolution(scene).values(), default=np.inf)
    return 1 + max(0.0, -float(np.log2(least))) if least > 0 else np.inf


# ---------------------------------------------------------------------------------- singular places


def corners(scene: Scene) -> np.ndarray:
    """Nodes `(n,)`, as booleans, where strains are infinite: ends of a clamp on the surface, and re-entrant corners of
    the body. The nodes must be concrete."""
    found, edges = np.zeros(len(scene.held), bool), scene.surface[:, :2]
    if not len(edges):
        return found
    held = scene.held[edges]
    ending = (held[:, 0] != held[:, 1]).any(axis=1)
    found[edges[ending][held[ending].any(axis=2)]] = True
    positions, before = np.asarray(scene.mesh.nodes), np.zeros((len(found), 2))
    along = positions[edges[:, 1]] - positions[edges[:, 0]]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    before[edges[:, 1]] = along
    first = before[edges[:, 0]]
    found[edges[first[:, 0] * along[:, 1] - first[:, 1] * along[:, 0] < -HOLLOW, 0]] = True
    return found


def loaded(scene: Scene, x: jax.Array) -> jax.Array:
    """Nodes `(n,)`, as booleans, on which an energy pushes that acts on single nodes, such as a dead load."""
    found = jnp.zeros(len(scene.held), bool)
    for term in scene.terms:
        if term.kind.pointwise:
            pushed = jnp.any(term.kind.gradients(x[term.nodes], term.params)[1] != 0, axis=2)
            found = found.at[term.nodes].max(pushed)
    return found & np.logical_not(scene.held.all(axis=1))


def reads_corner(places: Places, scene: Scene, finer: Scene, slope: jax.Array, finer_slope: jax.Array) -> jax.Array:
    """Whether, `()`, a measure reads strains of the elements at corners, where it has no limit; arguments as of
    `doubts`."""
    (near, whole), (finer_near, finer_whole) = _slopes_at(places.corners, scene, finer, slope, finer_slope)
    # The energy is stationary: on the coarser mesh its derivative is round-off.
    counts = (near > PART * whole) & (near > NOISE * finer_whole)
    return counts & (finer_near > KEPT * near)


def reads_load(scene: Scene, finer: Scene, x: jax.Array, slope: jax.Array, finer_slope: jax.Array) -> jax.Array:
    """Whether, `()`, a measure reads positions at a point load, or near it strains; arguments as of `doubts`."""
    (near, _), (finer_near, finer_whole) = _slopes_at(loaded(scene, x), scene, finer, slope, finer_slope)
    # The work of the load counts too, whose derivative shows on the finer mesh alone.
    return (finer_near > PART * finer_whole) & (finer_near > KEPT * near)


def reads_anchor(places: Places, scene: Scene, finer: Scene, slope: jax.Array, finer_slope: jax.Array) -> jax.Array:
    """Whether, `()`, a measure reads strains at an anchor that is narrower than the distance of nodes: they grow until
    these are as close as the anchor is wide. Arguments as of `doubts`."""
    (near, _), (finer_near, finer_whole) = _slopes_at(places.narrow, scene, finer, slope, finer_slope)
    # Derivatives of a strain grow as elements shrink. Those of a displacement, as of the anchor's, do not.
    return (finer_near > PART * finer_whole) & (finer_near > STEEPER * near)


def _slopes_at(places: Any, *arguments: Any) -> list[tuple[jax.Array, jax.Array]]:
    """The largest derivative of a measure, `()`, in the elements at certain nodes `(n,)`, and everywhere: on both
    meshes."""
    scene, finer, *slopes = arguments
    places, found = jnp.asarray(places), []
    for each, slope in zip((scene, finer), slopes, strict=True):
        size = jnp.linalg.norm(jnp.where(each.held, 0, slope), axis=1)
        marked = jnp.zeros(len(size), bool).at[: len(places)].set(places)
        near = jnp.any(marked[each.mesh.elements], axis=1)
        found.append((jnp.max(jnp.where(near, jnp.max(size[each.mesh.elements], axis=1), 0)), jnp.max(size)))
    return found


def squashed(at: np.ndarray, scene: Scene, x: jax.Array) -> jax.Array:
    """Positions `(n, 2)` at which the elements at the corners `at` `(n,)` are shrunk to a hundredth, which makes them
    the worst."""
    # Each node moves towards the corner in its element, and held nodes stay.
    near = np.argwhere(at[scene.mesh.elements])
    towards = np.arange(len(at))
    for element, place in near:
        towards[scene.mesh.elements[element]] = scene.mesh.elements[element, place]
    return jnp.where(scene.held, x, x[towards] + 0.01 * (x - x[towards]))


def takes_worst(at: np.ndarray, scene: Scene, slope: jax.Array, other: jax.Array) -> jax.Array:
    """Whether, `()`, a measure is the worst value in the body, which in the end lies at a corner.

    Args:
        at: `(n,)` the corners, as booleans.
        scene: of the state.
        slope: `(n, 2)` derivative of the measure in the positions.
        other: `(n, 2)` its derivative at the `squashed` positions. If the measure left the place where it was for the
            corner, it depends on no position beyond the elements that were squashed and their neighbours.
    """
    near, elements = at.copy(), scene.mesh.elements
    some = jnp.asarray(near.any())
    for _ in range(2):
        near[elements[near[elements].any(axis=1)]] = True
    beyond = jnp.max(jnp.abs(jnp.where(near[:, None], 0, other)))
    before = jnp.max(jnp.abs(slope))
    return some & (before > 0) & (beyond <= NOISE * before)


# ------------------------------------------------------------------------------------------- creases


class Softest(NamedTuple):
    """The piece of the surface that has lost most of its stiffness, of those that touch neither clamp nor corner.

    share: `()` smallest eigenvalue of its impedance, over that at rest. Below `SOFT` a crease may form; at 0 the
        surface wrinkles. Infinite if there is no such piece.
    stretch: `()` along the surface.
    place: `(2,)` its middle at rest.
    """

    share: jax.Array
    stretch: jax.Array
    place: jax.Array


def softest(at: np.ndarray, scene: Scene, x: jax.Array) -> Softest:
    """The softest piece of the surface at positions `x` `(n, 2)`, as if no load acted on it.

    Args:
        at: `(n,)` the corners, as booleans, near which no piece is looked at.
        scene: of the state.
        x: `(n, 2)` positions.
    """
    apart = ~(scene.held.any(axis=1) | at)
    found = [Softest(*(jnp.full(shape, jnp.inf, x.dtype) for shape in ((1,), (1,), (1, 2))))]
    for term in scene.terms:
        owners, sides = _at_surface(scene, term)
        chosen = apart[element_sides(term, owners, sides)].all(axis=1)
        if chosen.any():
            found.append(_pieces(term, scene.mesh.nodes, x, owners[chosen], sides[chosen]))
    every = Softest(*(jnp.concatenate(parts) for parts in zip(*found, strict=True)))
    least = jnp.argmin(every.share)
    return Softest(*(values[least] for values in every))


def element_sides(term: Term, owners: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """The end corners `(b, 2)` of side `sides` `(b,)` of each of the elements `owners` `(b,)`."""
    return term.nodes[owners[:, None], element_of(term.nodes).sides[sides]] if len(owners) else np.zeros((0, 2), int)


def _at_surface(scene: Scene, term: Term) -> tuple[np.ndarray, np.ndarray]:
    """Elements of a term that have a side on the surface, and which side, each `(b,)`; none of other energies."""
    if not term.kind.fills:
        return np.zeros(0, int), np.zeros(0, int)
    count = len(scene.held)
    every = term.nodes[:, element_of(term.nodes).sides].astype(np.int64)
    edges = scene.surface[:, :2].astype(np.int64)
    owners, sides = np.nonzero(np.isin(every @ [count, 1], edges @ [count, 1]))
    return owners, sides


def _pieces(term: Term, rest: jax.Array, x: jax.Array, owners: np.ndarray, sides: np.ndarray) -> Softest:
    """What is known of the middle of each side `(b,)` of elements of a solid."""
    element, ends = element_of(term.nodes), element_sides(term, owners, sides)
    params = jax.tree.map(lambda leaf: leaf[owners], term.params)

    def moduli(H: jax.Array, density: Any, material: Any) -> Any:
        second = jax.hessian(density)
        return second(H, material), second(0 * H, material), H + jnp.eye(2, dtype=H.dtype)

    found = term.kind.at_points(x[term.nodes[owners]], params, moduli)
    if found is None:
        return Softest(*(jnp.full((len(owners), *shape), jnp.inf, x.dtype) for shape in ((), (), (2,))))
    # From the quadrature points to the middle of the side.
    fit = points_to_nodes(element, found[0].shape[1])[element.sides].mean(axis=1)[sides]
    now, before, F = (jnp.einsum("bq,bq...->b...", jnp.asarray(fit, x.dtype), values) for values in found)
    side = jnp.asarray(rest)[ends]
    along = (side[:, 1] - side[:, 0]) / jnp.linalg.norm(side[:, 1] - side[:, 0], axis=1, keepdims=True)
    share = jax.vmap(stiffness_of_half_space)(now, along) / jax.vmap(stiffness_of_half_space)(before, along)
    return Softest(share, jnp.linalg.norm(jnp.einsum("bij,bj->bi", F, along), axis=1), side.mean(axis=1))


def stiffness_of_half_space(A: jax.Array, along: jax.Array) -> jax.Array:
    """The smallest eigenvalue `()` of the surface impedance of a half-space.

    Args:
        A: `(2, 2, 2, 2)` moduli `d2 psi / dF_iJ dF_kL`.
        along: `(2,)` unit vector along its surface at rest.
    """
    angles = np.arange(ANGLES) * np.pi / ANGLES
    across = jnp.stack([-along[1], along[0]])
    c, s = (jnp.asarray(values, A.dtype)[:, None] for values in (np.cos(angles), np.sin(angles)))
    m, n = c * along + s * across, c * across - s * along
    T, R = (jnp.einsum("tJ,iJkL,tL->tik", left, A, n) for left in (n, m))
    inverse = _inverse(T)
    H = jnp.mean(inverse, axis=0)
    S = -jnp.mean(jnp.einsum("tij,tkj->tik", inverse, R), axis=0)
    real = _inverse(H)
    half, turn = 0.5 * (real[0, 0] - real[1, 1]), (real @ S)[0, 1]
    return 0.5 * (real[0, 0] + real[1, 1]) - jnp.sqrt(half**2 + real[0, 1] ** 2 + turn**2)


def _inverse(matrix: jax.Array) -> jax.Array:
    """Inverse of matrices `(..., 2, 2)`."""
    a, b, c, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 0], matrix[..., 1, 1]
    adjugate = jnp.stack([jnp.stack([d, -b], axis=-1), jnp.stack([-c, a], axis=-1)], axis=-2)
    return adjugate / (a * d - b * c)[..., None, None]
