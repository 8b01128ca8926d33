"""The check before a solve that every piece of the mesh is held against rigid motion.

It runs on the host and needs concrete values. A scene that is not held can still be built, drawn and measured.

The rigid motions of a piece have three coordinates `q`: two translations, and the angle of a rotation about the centre
of the piece times its size. The terms other than the body resist these motions by the second variation of their energy,

    d2E/dq2 = J^T H J + sum g . d2x/dq2,     J = dx/dq,

with `g` and `H` the gradient and the Hessian of the energy in positions. The second part is there because a rotating
node moves on a circle: without it a taut tendon inside the piece would seem to resist, and a hanging load would not.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import jax
import numpy as np

from jaxbeam.core.tree import Key, is_concrete, key_of, replace, unlock
from jaxbeam.mesh.mesh import pieces
from jaxbeam.physics.energy import Term
from jaxbeam.scene.scene import Scene

# Bound of the round-off of a stencil's second variation, over eps of its dtype times the sum of the magnitudes added up
# in it. Measured on tendons inside a body, with guides, patches and eccentricities, up to 1e5 from the origin: at most
# 0.5.
NOISE = 64


class Rigid(NamedTuple):
    """The rigid motions of the `c` pieces of a mesh, three for each piece.

    piece: `(n,)` number of the piece of each node.
    centres: `(c, 2)` centre of each piece.
    sizes: `(c,)` largest extent of each piece.
    slope: `(n, d, 3 c)` derivative of the positions in the coordinates `q` of the motions.
    bend: `(n, d)` second derivative of the positions in the rotation of their piece.
    far: `(n, d)` scale of the round-off of `bend`, which grows with the distance from the origin.
    """

    piece: np.ndarray
    centres: np.ndarray
    sizes: np.ndarray
    slope: np.ndarray
    bend: np.ndarray
    far: np.ndarray


class Resistance(NamedTuple):
    """How a term resists the rigid motions of `c` pieces.

    second: `(3 c, 3 c)` second variation of its energy along the motions.
    slope: `(3 c,)` first derivative of its energy along the motions.
    noise: round-off of `second`.
    """

    second: np.ndarray
    slope: np.ndarray
    noise: float


def check_held(scene: Scene) -> None:
    """Refuse a scene in which a piece of the mesh can move rigidly and no clamp, spring or load resists.

    The tangent stiffness of such a scene is singular at rest. A solid or a rod never resists a rigid motion of its own,
    so only the other terms are evaluated, and only if the clamped nodes alone do not hold every piece. A load may also
    drive the motion, such as a load that stands on a hinge. Then the stiffness is not singular, and the scene passes:
    the solver finds where it goes. Nothing is refused while a value is traced, or where an energy is not finite.

    Raises:
        ValueError: if a piece is not held; it names the piece and its free motions.
    """
    known = is_concrete(scene.mesh.elements, scene.held)
    if known and _clamps_suffice(key_of(scene.mesh, "elements"), key_of(scene, "held")):
        return
    if not is_concrete(*jax.tree.leaves(scene)):
        return
    rigid = _rigid_motions(scene)
    _, values, basis = np.linalg.svd(rigid.slope[scene.held], full_matrices=True)
    free = basis[np.sum(values > 1e-9) :].T
    others = tuple(term for term in scene.terms if not term.kind.body)
    if free.shape[1] and others:
        free = _unresisted(replace(scene, terms=others), rigid, free)
    if not free.shape[1]:
        return
    count = len(rigid.centres)
    loose = free.reshape(count, 3, -1)
    k = int(np.argmax(np.linalg.norm(loose, axis=(1, 2))))
    node = np.argmax(rigid.piece == k)
    body = "the body" if count == 1 else f"the mesh is in {count} pieces, and the one with node {node}"
    motions = _name_motions(loose[k], rigid.centres[k], float(rigid.sizes[k]))
    raise ValueError(
        f"fixed: {body} is not held, it moves rigidly without resistance: {motions}; "
        f"fix more coordinates, for example with clamped(mesh, nodes), or hold it by penalty_springs"
    )


@lru_cache(maxsize=32)
def _clamps_suffice(elements: Key, fixed: Key) -> bool:
    """Whether each piece has enough clamped nodes to be held, wherever these lie: two nodes, or one of a rod."""
    piece = pieces(elements.array, fixed.array.shape[0])
    enough = 2 if fixed.array.shape[1] == 2 else 1
    return bool((np.bincount(piece, fixed.array.all(axis=1)) >= enough).all())


def _rigid_motions(scene: Scene) -> Rigid:
    """The rigid motions of a concrete scene, at rest."""
    whole = np.asarray(scene.mesh.nodes, float)
    piece, rest = pieces(scene.mesh.elements, len(whole)), whole[:, :2]
    own = [piece == k for k in range(int(piece.max()) + 1)]
    centres = np.stack([rest[nodes].mean(axis=0) for nodes in own])
    sizes = np.array([np.ptp(rest[nodes], axis=0).max() for nodes in own])
    arms, size = rest - centres[piece], sizes[piece]
    slope, bend, far = np.zeros((*whole.shape, len(own), 3)), np.zeros(whole.shape), np.zeros(whole.shape)
    node = np.arange(len(whole))
    slope[node, 0, piece, 0] = slope[node, 1, piece, 1] = 1
    slope[node, :2, piece, 2] = arms[:, ::-1] * [-1, 1] / size[:, None]
    if scene.mesh.is_line:
        # The third coordinate is an angle times `radian`. It is linear in the rotation and has no second derivative.
        slope[node, 2, piece, 2] = float(scene.mesh.radian) / size
    bend[:, :2] = -arms / size[:, None] ** 2
    far[:, :2] = (np.abs(arms) + np.abs(rest)) / size[:, None] ** 2
    return Rigid(piece, centres, sizes, slope.reshape(*whole.shape, -1), bend, far)


def _unresisted(scene: Scene, rigid: Rigid, free: np.ndarray) -> np.ndarray:
    """The motions `(3 c, u)` that no term resists, of the motions `free` `(3 c, f)` that fixed coordinates leave."""
    eps = float(np.finfo(scene.mesh.nodes.dtype).eps)
    # The scene is concrete, so its derivatives are constants, inside jit too.
    with jax.ensure_compile_time_eval():
        derivatives = jax.device_get(_derivatives(unlock(scene), scene.mesh.nodes))
    if not all(np.isfinite(each).all() for each in jax.tree.leaves(derivatives)):
        return free[:, :0]
    found = [_resistance(term, g, H, rigid, eps) for term, (g, H) in zip(scene.terms, derivatives, strict=True)]
    second, slope = (np.sum(parts, axis=0) for parts in ([f.second for f in found], [f.slope for f in found]))
    noise = sum(f.noise for f in found)
    # A fixed coordinate must not move to second order either. Its reaction acts like a load on a moving node.
    reactions = np.linalg.lstsq(rigid.slope[scene.held].T, slope)[0]
    turns = 3 * rigid.piece[np.nonzero(scene.held)[0]] + 2
    np.add.at(second, (turns, turns), -reactions * rigid.bend[scene.held])
    noise += NOISE * eps * float(np.abs(reactions) @ np.abs(rigid.bend[scene.held]))
    values, vectors = np.linalg.eigh(free.T @ second @ free)
    return free @ vectors[:, np.abs(values) <= noise]


@jax.jit
def _derivatives(scene: Scene, x: jax.Array) -> list[tuple[jax.Array, jax.Array]]:
    """For each term, gradients `(m, k, d)` and Hessians `(k d, k d, m)` of its stencils."""
    return [(t.kind.gradients(x[t.nodes], t.params)[1], t.kind.hessians(x[t.nodes], t.params)) for t in scene.terms]


def _resistance(term: Term, gradients: np.ndarray, hessians: np.ndarray, rigid: Rigid, eps: float) -> Resistance:
    """The resistance of a term.

    Values below the round-off of their stencil are set to zero before stencils are added up. Otherwise the round-off of
    a stiff tendon inside a piece would count as resistance, or hide the resistance of a weak spring.

    Args:
        term: with `m` stencils of `k` nodes.
        gradients: `(m, k, d)` of its stencils.
        hessians: `(k d, k d, m)` of its stencils.
        rigid: the motions.
        eps: of the scene's dtype.
    """
    size = rigid.slope.shape[2]
    second, slope, noise = np.zeros((size, size)), np.zeros(size), 0.0
    of_nodes = rigid.piece[term.nodes]
    together = np.sort(of_nodes, axis=1)
    for row in np.unique(together, axis=0):
        own = (together == row).all(axis=1)
        touched = np.unique(row)
        used = (3 * touched[:, None] + np.arange(3)).ravel()
        nodes = term.nodes[own]
        J = rigid.slope[nodes][..., used].reshape(len(nodes), -1, len(used))
        g, H = np.asarray(gradients, float)[own], np.moveaxis(np.asarray(hessians, float)[..., own], -1, 0)
        flat = g.reshape(len(nodes), -1)
        each = J.transpose(0, 2, 1) @ H @ J
        for k, piece in enumerate(touched):
            circling = np.where(of_nodes[own] == piece, np.sum(g * rigid.bend[nodes], axis=2), 0)
            each[:, 3 * k + 2, 3 * k + 2] += circling.sum(axis=1)
        stiff = (np.abs(J).transpose(0, 2, 1) @ np.abs(H) @ np.abs(J)).max(axis=(1, 2))
        force = np.sum(np.abs(g) * rigid.far[nodes], axis=(1, 2))
        values, vectors = np.linalg.eigh(each)
        values = np.where(np.abs(values) > NOISE * eps * (stiff + force)[:, None], values, 0)
        second[np.ix_(used, used)] += np.einsum("mpr,mr,mqr->pq", vectors, values, vectors)
        # Forces have a relative error of eps. Directions of a remaining stiffness are wrong by eps, and enter squared.
        rough = NOISE * eps * force + max(NOISE * float(np.finfo(float).eps), (NOISE * eps) ** 2) * stiff
        noise += float(rough[values.any(axis=1)].sum())
        pulls, most = np.einsum("ma,map->mp", flat, J), np.einsum("ma,map->mp", np.abs(flat), np.abs(J))
        slope[used] += np.where(np.abs(pulls) > NOISE * eps * most, pulls, 0).sum(axis=0)
    return Resistance(second, slope, noise)


def _name_motions(motions: np.ndarray, centre: np.ndarray, size: float) -> str:
    """Words for the space of rigid motions `(3, q)` of a piece, as translations and a rotation about `centre`."""
    basis, values, _ = np.linalg.svd(motions, full_matrices=False)
    basis = basis[:, values > 1e-6 * values.max()]
    inside = np.linalg.norm(basis, axis=1) > 1 - 1e-6
    names = [n for n, i in zip(("translation in x", "translation in y", "rotation"), inside, strict=True) if i]
    if len(names) == basis.shape[1]:
        return " and ".join(names)
    if basis.shape[1] == 1 and abs(basis[2, 0]) > 1e-6:
        pivot = centre + size * np.array([-basis[1, 0], basis[0, 0]]) / basis[2, 0]
        return f"rotation about ({pivot[0]:.4g}, {pivot[1]:.4g})"
    return f"{basis.shape[1]} independent motions, mixed of translation and rotation"
