"""What must hold before a scene is solved: every piece of its mesh is held against rigid motion.

Checked on the host, while everything is concrete. A scene that is not held can still be built, drawn and measured.
"""

from __future__ import annotations

from functools import lru_cache

import jax
import numpy as np

from jaxbeam._tree import Key, is_concrete, key_of, replace
from jaxbeam.mesh import pieces
from jaxbeam.rod import Line, RodEnergy
from jaxbeam.scene import Scene, stencil_hessians
from jaxbeam.terms import SolidEnergy


def check_held(scene: Scene) -> None:
    """Refuse a scene in which a piece of the mesh moves rigidly, against no clamp and no spring.

    Its tangent stiffness would be singular at rest. A solid or a rod itself never resists a rigid motion, so only
    the other terms are asked, and only if clamped nodes alone do not hold every piece.

    Raises:
        ValueError: that names the piece and its free motions. Nothing is checked while a value is traced.
    """
    known = is_concrete(scene.mesh.elements, scene.fixed)
    if known and _clamps_suffice(key_of(scene.mesh, "elements"), key_of(scene, "fixed")):
        return
    if not is_concrete(*jax.tree.leaves(scene)):
        return
    whole, piece = np.asarray(scene.mesh.nodes, float), pieces(scene.mesh.elements, scene.mesh.nodes.shape[0])
    rest = whole[:, :2]
    count = int(piece.max()) + 1
    size = float(np.ptp(rest, axis=0).max())
    centres = [rest[piece == k].mean(axis=0) for k in range(count)]
    motions = np.zeros((*whole.shape, count, 3))
    for k, centre in enumerate(centres):
        own = piece == k
        motions[own, 0, k, 0] = motions[own, 1, k, 1] = 1
        motions[own, :2, k, 2] = (rest[own] - centre)[:, ::-1] * [-1, 1] / size
        if isinstance(scene.mesh, Line):
            motions[own, 2, k, 2] = float(scene.mesh.radian) / size
    motions = motions.reshape(whole.size, 3 * count)
    _, values, basis = np.linalg.svd(motions[scene.fixed.ravel()], full_matrices=True)
    free = basis[np.sum(values > 1e-9) :].T
    others = tuple(term for term in scene.terms if not isinstance(term.energy, SolidEnergy | RodEnergy))
    if free.shape[1] and others:
        resistance = np.zeros((free.shape[1], free.shape[1]))
        moved = (motions @ free).reshape(*whole.shape, -1)
        for term, hessians in zip(
            others, stencil_hessians(replace(scene, terms=others), scene.mesh.nodes), strict=True
        ):
            local = moved[term.nodes].reshape(len(term.nodes), -1, free.shape[1])
            resistance += np.einsum("map,abm,mbq->pq", local, np.asarray(hessians, float), local)
        values, vectors = np.linalg.eigh(resistance)
        free = free @ vectors[:, values <= 1e-9 * max(float(np.abs(values).max()), np.finfo(float).tiny)]
    if not free.shape[1]:
        return
    loose = free.reshape(count, 3, -1)
    k = int(np.argmax(np.linalg.norm(loose, axis=(1, 2))))
    body = "the body" if count == 1 else f"the mesh is in {count} pieces, and the one with node {np.argmax(piece == k)}"
    raise ValueError(
        f"fixed: {body} is not held, it moves rigidly without resistance: {_name_motions(loose[k], centres[k], size)}; "
        f"fix more coordinates, for example with clamped(mesh, nodes), or hold it by penalty_springs"
    )


@lru_cache(maxsize=32)
def _clamps_suffice(elements: Key, fixed: Key) -> bool:
    """Whether each piece of the mesh has as many clamped nodes as hold it wherever they are: two, or one of a rod."""
    piece = pieces(elements.array, fixed.array.shape[0])
    enough = 2 if fixed.array.shape[1] == 2 else 1
    return bool((np.bincount(piece, fixed.array.all(axis=1)) >= enough).all())


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
