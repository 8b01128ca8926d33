"""A scene: a mesh, what is fixed, and the terms whose energies are summed.

A scene is data, a pytree whose leaves are floats: JAX traces, maps and differentiates through it, and a
design is an ordinary function `theta -> Scene`. Units are the user's: forces come out in the unit of
Young's modulus x length (thickness is 1), energies in force x length.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import (
    Numbers,
    index_field,
    is_concrete,
    key_of,
    numbers_in_words,
    pytree,
    read_only,
    replace,
    why_unknown,
)
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.mesh.sketch import page
from jaxbeam.mesh.surface import surface_of
from jaxbeam.physics.energy import Term, check_nodes
from jaxbeam.scene.sketch import picture


@pytree
class Scene:
    """What is simulated: a mesh, the energies on it, and the coordinates that are fixed.

    Args:
        mesh: the body at rest, with `n` nodes of `d` coordinates: 2, or 3 on a `Line` (see `jaxbeam.mesh.line`).
        terms: the energies that are summed; one that is absent is never traced.
        fixed: `(n, d)` booleans, true for a coordinate that does not move (see `clamped`).
        tip: `(q,)` node numbers of the end section that the tip measures follow; may be empty.

    Two attributes are computed: `surface`, `(e, 2)` or `(e, 3)`, the edges of the surface of the solids by node numbers
    (see `jaxbeam.mesh.surface`); and `held` `(n, d)`, true for a coordinate that is fixed or that a support moves. Held
    coordinates are eliminated from the unknowns.

    Raises:
        ValueError: if `fixed` or `tip` has another shape or dtype, all is fixed, a coordinate is held twice, a term's
            node is out of range, a term of solids acts on a rod, or an energy returns no scalar.
    """

    mesh: Mesh
    terms: tuple[Term, ...]
    fixed: np.ndarray = index_field()
    tip: np.ndarray = index_field(default_factory=lambda: np.zeros(0, np.int32))
    surface: np.ndarray = index_field(init=False)
    held: np.ndarray = index_field(init=False)

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
        if isinstance(self.terms, list):
            object.__setattr__(self, "terms", tuple(self.terms))
        if not isinstance(self.terms, tuple) or not self.terms or not all(isinstance(t, Term) for t in self.terms):
            raise ValueError(f"terms: expected a tuple of at least one Term, got {self.terms!r}")
        for number, term in enumerate(self.terms):
            check_nodes(f"terms[{number}].nodes", self.mesh, term.nodes, ndim=2)
            _check_dtype(number, term, self.mesh.nodes.dtype)
            if term.kind.coordinates not in (None, shape[1]):
                raise ValueError(
                    f"terms[{number}]: it is made for nodes of {term.kind.coordinates} coordinates, got a mesh with "
                    f"{shape[1]}; on triangles use solid and tendons, on the Line of a rod use rod and rod_tendons"
                )
            _check_energy(number, term, self.mesh.nodes)
        held = _held(fixed, self.terms)
        for number, term in enumerate(self.terms):
            if objection := term.kind.objection(term, held):
                raise ValueError(f"terms[{number}]: {objection}")
        tip = check_nodes("tip", self.mesh, self.tip, ndim=1) if np.size(self.tip) else np.zeros(0)
        object.__setattr__(self, "fixed", read_only(fixed))
        object.__setattr__(self, "held", read_only(held))
        object.__setattr__(self, "tip", read_only(tip, np.int32))
        bodies = tuple(key_of(term, "nodes") for term in self.terms if term.kind.fills)
        object.__setattr__(self, "surface", surface_of(bodies))

    def __repr__(self) -> str:
        return f"Scene({'; '.join(_facts(self))})"

    def __str__(self) -> str:
        return "\n  ".join(["Scene", *_facts(self)])

    def _repr_html_(self) -> str:
        """A small picture of the body at rest and what acts on it, and the facts: what a notebook shows."""
        return page(_picture(self), ["; ".join(_facts(self))])


@usual_rules
def _facts(scene: Scene) -> list[str]:
    """Size, mesh, terms, unknowns and commands of a scene in words."""
    unknown, nodes = why_unknown(scene, scene.mesh.nodes), scene.mesh.nodes
    if unknown not in ("", "traced"):
        return [unknown]
    if not _is_one(scene):
        return [f"{unknown} stack of scenes".strip(), scene.mesh.summary()]
    size = "" if unknown else " x ".join(f"{extent:.6g}" for extent in np.ptp(np.asarray(nodes)[:, :2], axis=0)) + ", "
    facts = [size + scene.mesh.summary(), ", ".join(f"{len(term.nodes)} x {_kind(term)}" for term in scene.terms)]
    if is_concrete(scene.held):
        facts.append(f"{int((~scene.held).sum())} of {scene.fixed.size} coordinates free")
    if command_count(scene):
        with jax.debug_nans(False), jax.debug_infs(False):
            facts.append("commands " + (unknown or numbers_in_words(commands_of(scene))))
    return facts


def _kind(term: Term) -> str:
    """The word for a stencil of a term; of a material also its density, and of a user's function its name."""
    parts = [part for part in vars(term.kind).values() if callable(part)]
    shown = parts[:1] if term.kind.body or term.kind is not term.energy else []
    return " ".join([term.kind.name, *(f"({getattr(part, '__name__', type(part).__name__)})" for part in shown)])


def _is_one(scene: Scene) -> bool:
    """Whether it is one scene, and not a stack of many that JAX has made of some or all of its leaves."""
    shapes = [(len(term.nodes), np.shape(leaf)) for term in scene.terms for leaf in jax.tree.leaves(term.params)]
    if scene.mesh.nodes.ndim != 2 or any(shape[:1] != (count,) for count, shape in shapes):
        return False
    # The commands of a gradient by a scene may be 0 / 0.
    with jax.debug_nans(False), jax.debug_infs(False):
        return all(term.kind.command_of(term.params).shape == (term.command_count,) for term in commanded_terms(scene))


@usual_rules
def _picture(scene: Scene) -> str:
    """SVG of a scene; empty for a stack of scenes."""
    if why_unknown(scene, scene.mesh.nodes) or not _is_one(scene):
        return ""
    with jax.debug_nans(False), jax.debug_infs(False):
        return picture(scene.mesh, scene.terms, scene.fixed, scene.held)


def _held(fixed: np.ndarray, terms: tuple[Term, ...]) -> np.ndarray:
    """Coordinates `(n, d)` that are fixed or that a support holds; refused if one is held twice, or none is free."""
    held, names = fixed.copy(), ("x", "y", "the angle")
    for number, term in enumerate(terms):
        if not term.kind.holds:
            continue
        nodes, own = np.asarray(term.nodes).ravel(), np.zeros(fixed.shape, bool)
        own[nodes] = term.kind.holds
        if (own & held).any():
            node, coordinate = np.argwhere(own & held)[0]
            other = "`fixed`" if fixed[node, coordinate] else "another support"
            raise ValueError(
                f"terms[{number}]: {other} holds {names[coordinate]} of node {node} too, so it may be told two "
                f"displacements; leave that node or coordinate out of one of them"
            )
        held |= own
    if held.all():
        raise ValueError("fixed: every coordinate is fixed, nothing is left to solve for")
    return held


def _check_dtype(number: int, term: Term, dtype: Any) -> None:
    """Refuse float parameters wider than the nodes' dtype: energies would have another dtype than positions."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(term.params):
        if leaf.dtype.kind == "f" and leaf.dtype.itemsize > dtype.itemsize:
            raise ValueError(
                f"terms[{number}].params{jax.tree_util.keystr(path)}: expected {dtype}, the dtype of the mesh's nodes, "
                f"got {leaf.dtype}; build the terms on the same mesh, or convert with .astype({dtype})"
            )


@usual_rules
def _check_energy(number: int, term: Term, nodes: jax.Array) -> None:
    """Refuse an energy that returns no scalar."""
    leaves, structure = jax.tree.flatten(term.params)
    shapes = [((term.nodes.shape[1], nodes.shape[1]), nodes.dtype), *((leaf.shape[1:], leaf.dtype) for leaf in leaves)]
    _traced_once(f"terms[{number}].energy", term.energy, structure, tuple(shapes))


@lru_cache(maxsize=64)
def _traced_once(name: str, energy: Callable[..., jax.Array], structure: Any, shapes: tuple[Any, ...]) -> None:
    """Trace an energy to check that it returns a scalar; cached, so that each energy is traced once for its shapes."""
    x, *leaves = (jax.ShapeDtypeStruct(*each) for each in shapes)
    checks.scalar(name, "(x, params)", energy, x, jax.tree.unflatten(structure, leaves))


def check_scene(scene: Scene) -> None:
    """Check that `scene` is a `Scene`, and that float64 is switched on if its nodes are float64.

    They may be float64 all the same where `jax_enable_x64` was switched off after the scene was made.

    Raises:
        ValueError: if not.
    """
    checks.instance("scene", scene, Scene, "make one with tendon_beam(), rod_beam() or Scene(mesh, terms, fixed, tip)")
    dtype = scene.mesh.nodes.dtype
    if jax.dtypes.canonicalize_dtype(dtype) != dtype:
        raise ValueError(
            "scene: its nodes are float64, which JAX computes with only while jax_enable_x64 is on; set "
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


# ------------------------------------------------------------------------------------------- commands


@usual_rules
def command(scene: Scene, commands: Numbers) -> Scene:
    """The scene under new commands: one for each commanded stencil, or one for all stencils of a term that share it.

    Args:
        scene: with `m` commands in all, in the order of its terms.
        commands: `(m,)`; differentiable. The command of a tendon is the ratio of its commanded to its natural length.

    Raises:
        ValueError: if the count is wrong or a concrete command is out of its range, such as a ratio that is not
            positive.
    """
    check_scene(scene)
    values = checked_commands("ratios", scene, commands)
    terms, start = [], 0
    for term in scene.terms:
        if term.kind.rest_command is not None:
            stop = start + term.command_count
            term, start = replace(term, params=term.kind.command(term.params, values[start:stop])), stop
        terms.append(term)
    return replace(scene, terms=tuple(terms))


def checked_commands(name: str, scene: Scene, commands: Numbers) -> Any:
    """Commands `(m,)` of a scene as numbers; refused if their count is wrong, or as `check_commands` does."""
    kinds = [(term.command_count, term.kind.name) for term in commanded_terms(scene)]
    only_tendons = all(kind == "tendon" for _, kind in kinds)
    each = "one for each tendon" if only_tendons else "for " + ", ".join(f"{count} x {kind}" for count, kind in kinds)
    values = checks.shaped(name, commands, ((command_count(scene),),), each)
    check_commands(name, scene, values)
    return values


def check_commands(name: str, scene: Scene, values: Any) -> None:
    """Refuse concrete commands `(..., m)` that are out of the range of the term that they command.

    Traced commands are checked by `is_valid`, like all parameters.
    """
    if not is_concrete(values):
        return
    start, several = 0, len(commanded_terms(scene)) > 1
    for term in commanded_terms(scene):
        stop = start + term.command_count
        which = f"{name}[{start}:{stop}]" if several else name
        checks.inside(which, values[..., start:stop], term.kind.commands, why=term.kind.command_hint)
        start = stop


def commanded_terms(scene: Scene) -> list[Term]:
    """The terms that take commands, in order. Commands are numbered consecutively over all of them."""
    return [term for term in scene.terms if term.kind.rest_command is not None]


def command_count(scene: Scene) -> int:
    """Number of commands `m` of a scene."""
    return sum(term.command_count for term in scene.terms)


def commands_of(scene: Scene) -> jax.Array:
    """The commands `(m,)` that the scene is under now."""
    found = [term.kind.command_of(term.params) for term in commanded_terms(scene)]
    return jnp.concatenate([*found, jnp.zeros(0, scene.mesh.nodes.dtype)])


def rest_commands(scene: Scene) -> np.ndarray:
    """The commands `(m,)` at which the commanded terms do nothing: 1 for a tendon."""
    found = [np.full(term.command_count, term.kind.rest_command) for term in commanded_terms(scene)]
    return np.concatenate([*found, np.zeros(0)]).astype(scene.mesh.nodes.dtype)


def command_units(scene: Scene, low: jax.Array, high: jax.Array) -> jax.Array:
    """Unit `(m,)` in which changes of each command are measured: 1 for ratios, else the width of its bounds.

    Args:
        scene: with `m` commands.
        low: `(m,)` lower bounds.
        high: `(m,)` upper bounds. Where they equal the lower ones, the unit is 1.
    """
    units = [np.full(term.command_count, term.kind.command_unit, float) for term in commanded_terms(scene)]
    known = np.concatenate([*units, np.zeros(0)]).astype(low.dtype)
    width = lax.stop_gradient(high - low)
    return jnp.where(np.isfinite(known), known, jnp.where(width > 0, width, 1))


def has_supports(scene: Scene) -> bool:
    """Whether some held coordinates move."""
    return any(term.kind.holds for term in scene.terms)


def places(scene: Scene) -> jax.Array:
    """Positions `(n, d)` at which held coordinates are to be; of the others, those at rest."""
    x = scene.mesh.nodes
    for term in scene.terms:
        if term.kind.holds:
            x = x.at[term.nodes].add(term.kind.displacements(term.params))
    return x


def at_places(scene: Scene, x: jax.Array) -> jax.Array:
    """Positions `x` `(n, d)` with held coordinates at their places; if nothing moves them, `x` itself."""
    return jnp.where(scene.held, places(scene), x) if has_supports(scene) else x


def partway(scene: Scene, share: jax.Array) -> Scene:
    """The scene with a share `()` of its actuation and its loads: none at 0, all at 1."""
    terms = [replace(term, params=term.kind.partway(term.params, share)) for term in scene.terms]
    return replace(scene, terms=tuple(terms))


def is_valid(scene: Scene) -> jax.Array:
    """Whether every parameter is in its range, `()`: the checks of the builders, for values that they saw traced."""
    valid = jnp.all(jnp.isfinite(scene.mesh.nodes))
    for term in scene.terms:
        for leaf in jax.tree.leaves(term.params):
            valid &= jnp.all(jnp.isfinite(leaf)) if jnp.issubdtype(leaf.dtype, jnp.inexact) else True
        valid &= term.kind.valid(term.params)
    return valid


def longest_increment(start: Scene, end: Scene) -> jax.Array | None:
    """The largest share `()` of the way between two scenes that may be taken in one solve; None: all of it.

    Some energies limit the change of their commands, see `Energy.stride`.
    """
    limits = []
    for here, there in zip(start.terms, end.terms, strict=True):
        stride = there.kind.stride(there.params)
        if stride is not None:
            change = jnp.max(jnp.abs(there.kind.command_of(there.params) - here.kind.command_of(here.params)))
            limits.append(stride / jnp.maximum(change, stride))
    return jnp.min(jnp.stack(limits)) if limits else None


def extent(scene: Scene) -> jax.Array:
    """The size of the body `()`: its largest extent at rest. It does not depend on where the body lies."""
    return jnp.max(jnp.ptp(scene.mesh.nodes, axis=0))
