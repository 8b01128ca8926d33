"""A scene: a mesh, what is fixed, and the terms whose energies are summed.

A scene is data, a pytree whose leaves are floats: JAX traces, maps and differentiates through it, and a
design is an ordinary function `theta -> Scene`. Units are the user's: forces come out in the unit of
Young's modulus x length (thickness is 1), energies in force x length.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import (
    Numbers,
    index_field,
    is_concrete,
    key_of,
    namespace,
    pytree,
    read_only,
    replace,
    to_device,
)
from jaxbeam.mesh.line import Line
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.mesh.surface import surface_of
from jaxbeam.physics.energy import Term, check_nodes
from jaxbeam.physics.load import dead_load_energy
from jaxbeam.physics.materials import Lame
from jaxbeam.physics.rod import RodEnergy, fibre_stretches
from jaxbeam.physics.rod_tendon import at_offsets
from jaxbeam.physics.solid import SolidEnergy, forbids_inversion
from jaxbeam.physics.stencils import admissible_step, rest_is_sound, smallest_ratios, stencil_gradients, stencil_hessian
from jaxbeam.physics.tendon import TendonEnergy


@pytree
class Scene:
    """What is simulated.

    Args:
        mesh: the body at rest, with `n` nodes of `d` coordinates: 2, or 3 on a `Line` (see `jaxbeam.rod`).
        terms: the energies that are summed; one that is absent is never traced.
        fixed: `(n, d)` booleans, true for a coordinate that does not move (see `clamped`). It is
            eliminated from the unknowns.
        tip: `(q,)` node numbers of the end section that the tip measures follow; may be empty.

    Besides, `surface` `(e, 2)` or `(e, 3)` holds the edges of the surface of its solids (see `jaxbeam.mesh.surface`).

    Raises:
        ValueError: if `fixed` or `tip` has another shape or dtype, all is fixed, a term's node is out of range,
            a term of solids acts on a rod, or an energy returns no scalar.
    """

    mesh: Mesh
    terms: tuple[Term, ...]
    fixed: np.ndarray = index_field()
    tip: np.ndarray = index_field(default_factory=lambda: np.zeros(0, np.int32))
    surface: np.ndarray = index_field(init=False)

    def __post_init__(self) -> None:
        checks.instance(
            "mesh", self.mesh, Mesh, "make one with rectangle(length, height, nx, ny) or Mesh(nodes, elements)"
        )
        shape = self.mesh.nodes.shape
        if not is_concrete(self.fixed, self.tip):
            raise ValueError("fixed, tip: expected concrete arrays, got traced ones; choose nodes outside jit and grad")
        fixed = checks.plain("fixed", self.fixed, f"booleans of shape {shape}")
        if fixed.shape != shape or fixed.dtype != bool:
            raise ValueError(
                f"fixed: expected booleans of shape {shape}, got shape {fixed.shape} of dtype {fixed.dtype}; "
                f"make them with clamped(mesh, nodes)"
            )
        if fixed.all():
            raise ValueError("fixed: every coordinate is fixed, nothing is left to solve for")
        if not isinstance(self.terms, tuple) or not self.terms or not all(isinstance(t, Term) for t in self.terms):
            raise ValueError(f"terms: expected a tuple of at least one Term, got {self.terms!r}")
        for number, term in enumerate(self.terms):
            check_nodes(f"terms[{number}].nodes", self.mesh, term.nodes, ndim=2)
            _check_dtype(number, term, self.mesh.nodes.dtype)
            energy = term.energy
            _check_energy(number, term, self.mesh.nodes)
            of_solids = isinstance(energy, SolidEnergy) or (
                isinstance(energy, TendonEnergy) and energy.points is not at_offsets
            )
            if isinstance(self.mesh, Line) and of_solids:
                raise ValueError(f"terms[{number}]: it is made for solids; on a Line use rod and rod_tendons")
        tip = check_nodes("tip", self.mesh, self.tip, ndim=1) if np.size(self.tip) else np.zeros(0)
        object.__setattr__(self, "fixed", read_only(fixed))
        object.__setattr__(self, "tip", read_only(tip, np.int32))
        bodies = tuple(key_of(term, "nodes") for term in self.terms if isinstance(term.energy, SolidEnergy))
        object.__setattr__(self, "surface", surface_of(bodies))


def _check_dtype(number: int, term: Term, dtype: Any) -> None:
    """Refuse parameters of more digits than the nodes have: energies would have another dtype than positions."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(term.params):
        if leaf.dtype.kind == "f" and leaf.dtype.itemsize > dtype.itemsize:
            raise ValueError(
                f"terms[{number}].params{jax.tree_util.keystr(path)}: expected {dtype}, the dtype of the mesh's nodes, "
                f"got {leaf.dtype}; build the terms on the same mesh, or convert with .astype({dtype})"
            )


def _check_energy(number: int, term: Term, nodes: jax.Array) -> None:
    """Refuse an energy of a user's own that returns no scalar."""
    if isinstance(term.energy, SolidEnergy | RodEnergy | TendonEnergy):
        return
    leaves, structure = jax.tree.flatten(term.params)
    shapes = [((term.nodes.shape[1], nodes.shape[1]), nodes.dtype), *((leaf.shape[1:], leaf.dtype) for leaf in leaves)]
    _traced_once(f"terms[{number}].energy", term.energy, structure, tuple(shapes))


@lru_cache(maxsize=64)
def _traced_once(name: str, energy: Callable[..., jax.Array], structure: Any, shapes: tuple[Any, ...]) -> None:
    x, *leaves = (jax.ShapeDtypeStruct(*each) for each in shapes)
    checks.scalar(name, "(x, params)", energy, x, jax.tree.unflatten(structure, leaves))


def check_scene(scene: Scene) -> None:
    """Refuse what is not a scene."""
    checks.instance("scene", scene, Scene, "make one with tendon_beam(), rod_beam() or Scene(mesh, terms, fixed, tip)")
    dtype = scene.mesh.nodes.dtype
    if dtype == np.float64 and jnp.result_type(float) != dtype:
        raise ValueError(
            "scene: its nodes are float64, which JAX computes with only where jax_enable_x64 is on; set "
            'jax.config.update("jax_enable_x64", True), or build the scene with dtype=jnp.float32'
        )


def placed(scene: Scene, x: Numbers, name: str = "x") -> jax.Array:
    """Node positions `x` of a scene, checked."""
    check_scene(scene)
    return checks.positions(name, x, scene.mesh.nodes.shape, scene.mesh.nodes.dtype)


def clamped(mesh: Mesh, nodes: Numbers) -> np.ndarray:
    """`(n, d)` booleans that fix every coordinate of `nodes` `(m,)`."""
    where = check_nodes("nodes", mesh, nodes, ndim=1)
    fixed = np.zeros(mesh.nodes.shape, bool)
    fixed[where] = True
    return fixed


@usual_rules
def command(scene: Scene, ratios: Numbers) -> Scene:
    """The scene with new commanded lengths, `ratio * natural length`.

    Args:
        scene: with `m` tendons.
        ratios: `(m,)`, positive, in the order of the tendons; differentiable.

    Raises:
        ValueError: if the count is wrong or a concrete ratio is not positive and finite.
    """
    check_scene(scene)
    ratios = checks.shaped("ratios", ratios, ((tendon_count(scene),),), "one for each tendon")
    # `is_valid` looks at traced ones: the commanded length is a parameter.
    if is_concrete(ratios):
        checks.inside("ratios", ratios, checks.POSITIVE, why="1 is the natural length and 0.5 half of it")
    terms, start = [], 0
    for term in scene.terms:
        if isinstance(term.energy, TendonEnergy):
            stop, natural = start + term.nodes.shape[0], term.params.natural
            xp = namespace(ratios, natural)
            commanded = xp.asarray(ratios, natural.dtype)[start:stop] * xp.asarray(natural)
            params = replace(term.params, commanded=to_device(commanded))
            term, start = replace(term, params=params), stop
        terms.append(term)
    return replace(scene, terms=tuple(terms))


def partway(scene: Scene, fraction: jax.Array) -> Scene:
    """The scene with only a fraction of its actuation: of every tendon's shortening and every dead load."""
    terms = []
    for term in scene.terms:
        params = term.params
        if isinstance(term.energy, TendonEnergy):
            params = replace(params, commanded=(1 - fraction) * params.natural + fraction * params.commanded)
        elif term.energy is dead_load_energy:
            params = replace(params, value=fraction * params.value)
        terms.append(replace(term, params=params))
    return replace(scene, terms=tuple(terms))


def ratios_of(scene: Scene) -> jax.Array:
    """The ratio `(m,)` that each tendon is commanded to now."""
    found = [term.params.commanded / term.params.natural for term in tendon_terms(scene)]
    return jnp.concatenate([*found, jnp.zeros(0, scene.mesh.nodes.dtype)])


def is_valid(scene: Scene) -> jax.Array:
    """Whether every parameter `()` is in its range: what the builders check, for values that were traced."""
    valid = jnp.all(jnp.isfinite(scene.mesh.nodes))
    for term in scene.terms:
        for leaf in jax.tree.leaves(term.params):
            valid &= jnp.all(jnp.isfinite(leaf)) if jnp.issubdtype(leaf.dtype, jnp.inexact) else True
        if isinstance(term.energy, TendonEnergy):
            valid &= jnp.all((term.params.commanded > 0) & (term.params.modulus > 0))
        if isinstance(term.energy, RodEnergy):
            valid &= jnp.all((term.params.height > 0) & (term.params.radian > 0))
        if isinstance(term.energy, SolidEnergy):
            valid &= jnp.all(rest_is_sound(term.params))
        bodily = isinstance(term.energy, SolidEnergy | RodEnergy)
        if bodily and isinstance(material := term.params.material, Lame):
            # 3 lam + 2 mu = E / (1 - 2 nu): with mu > 0 it is positive just when nu is in (-1, 0.5).
            valid &= jnp.all((material.mu > 0) & (3 * material.lam + 2 * material.mu > 0))
    return valid


def tendon_terms(scene: Scene) -> list[Term]:
    """The terms that are tendons, in order; their tendons are numbered through."""
    return [term for term in scene.terms if isinstance(term.energy, TendonEnergy)]


def tendon_count(scene: Scene) -> int:
    """How many tendons there are to command."""
    return sum(term.nodes.shape[0] for term in tendon_terms(scene))


def solid_terms(scene: Scene) -> list[Term]:
    """The terms that are solids, in order."""
    return [term for term in scene.terms if isinstance(term.energy, SolidEnergy)]


def rod_terms(scene: Scene) -> list[Term]:
    """The terms that are rods, in order."""
    return [term for term in scene.terms if isinstance(term.energy, RodEnergy)]


# ------------------------------------------------------------------------- energy, forces, Hessians


def extent(scene: Scene) -> jax.Array:
    """The size of the body `()`: its largest extent at rest, wherever it lies."""
    return jnp.max(jnp.ptp(scene.mesh.nodes, axis=0))


class Evaluation(NamedTuple):
    """Energy `()` and its gradient `(n, 2)`, each with the sum of the magnitudes that were added up in it.

    The second of each pair tells how large its round-off is, and what a relative residual is relative to.
    """

    energy: jax.Array
    energy_scale: jax.Array
    gradient: jax.Array
    gradient_scale: jax.Array


def evaluate(scene: Scene, x: jax.Array) -> Evaluation:
    """Energy and gradient at node positions `x` `(n, 2)`."""
    energy = energy_scale = jnp.zeros((), x.dtype)
    both = jnp.zeros((*x.shape, 2), x.dtype)
    for term in scene.terms:
        energies, gradients = stencil_gradients(term, x)
        energy += jnp.sum(energies)
        energy_scale += jnp.sum(jnp.abs(energies))
        both = both.at[term.nodes].add(jnp.stack([gradients, jnp.abs(gradients)], axis=-1))
    return Evaluation(energy, energy_scale, both[..., 0], both[..., 1])


@usual_rules
def energy(scene: Scene, x: jax.Array) -> jax.Array:
    """Total energy `()` at node positions `x` `(n, 2)`; differentiable in the scene and in `x`."""
    x = placed(scene, x)
    return sum((jnp.sum(jax.vmap(t.energy)(x[t.nodes], t.params)) for t in scene.terms), jnp.zeros((), x.dtype))


@usual_rules
def forces(scene: Scene, x: jax.Array) -> jax.Array:
    """Force `(n, 2)` of all terms on each node: minus the gradient of the energy."""
    return -evaluate(scene, placed(scene, x)).gradient


@usual_rules
def reactions(scene: Scene, x: jax.Array) -> jax.Array:
    """Force `(n, 2)` of the clamp on each node, zero for coordinates that are free.

    At equilibrium the reactions balance every load from outside; the tendons, which push on the body
    at both ends, are part of the body.
    """
    return jnp.where(scene.fixed, -forces(scene, x), 0)


def stencil_hessians(scene: Scene, x: jax.Array, convex: bool = False) -> list[jax.Array]:
    """For each term, the `(k d, k d, m)` Hessians of its stencils, by autodiff; or positive semidefinite ones."""
    return [stencil_hessian(term, x, convex) for term in scene.terms]


@usual_rules
def smallest_jacobian(scene: Scene, x: jax.Array) -> jax.Array:
    """Smallest `J = det F` `()` anywhere in the solids at `x`, or stretch of a fibre of the rods; infinite if there are
    neither. It is not only looked for at quadrature points."""
    return worst_element(scene, placed(scene, x))[0]


def worst_element(scene: Scene, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The smallest `J` `()` anywhere in the solids, or stretch of a fibre of the rods, and the number `()` of its
    element (-1 in a scene without either)."""
    ratios = [smallest_ratios(x[t.nodes], t.params) for t in solid_terms(scene)]
    ratios += [jnp.min(jax.vmap(fibre_stretches)(x[t.nodes], t.params), axis=1) for t in rod_terms(scene)]
    if not ratios:
        return jnp.asarray(jnp.inf, x.dtype), jnp.asarray(-1, jnp.int32)
    every = jnp.concatenate(ratios)
    element = jnp.argmin(every)
    return every[element], element.astype(jnp.int32)


# An element under this `J` is let through zero, where its energy allows that: held back, it would be approached
# in ever smaller steps. It may well come back, and if it does not, the solution says so. Away from the quadrature
# points every energy allows it.
RELEASED = 0.1


def largest_step(scene: Scene, x: jax.Array, dx: jax.Array, keep: float) -> jax.Array:
    """Largest `t` for which every element keeps the fraction `keep` of its `J` on the way to `x + t dx`.

    The quadrature points of a density that forbids inversion always do; all else only while it is not under
    `RELEASED`.
    """
    limits = [jnp.asarray(jnp.inf, x.dtype)]
    for term in solid_terms(scene):
        assert isinstance(term.energy, SolidEnergy)
        bound = 0.0 if forbids_inversion(term.energy, term.params) else RELEASED
        steps = admissible_step(x[term.nodes], dx[term.nodes], term.params, keep, bound, RELEASED)
        limits.append(jnp.min(steps))
    return jnp.min(jnp.stack(limits))
