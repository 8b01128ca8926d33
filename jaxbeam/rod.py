"""Planar rods: slender beams whose nodes carry a position and the angle of their section.

A rod is a line of nodes with rigid sections (Reissner, J. Appl. Math. Phys. 23 (1972), 795-804; Simo, Comput. Methods
Appl. Mech. Eng. 49 (1985), 55-70). With `r(s)` the axis, `theta` the angle of the section's normal, anticlockwise from
x, and `s` the arc length at rest,

    Gamma = R(theta)^T r' = (1 + eps, gamma),     kappa = theta',

the stretch of the axis, the shear and the curvature, each less what it is at rest. A fibre at the height `y` is
stretched to `1 + e = 1 + eps - y kappa`, and the energy of a length `ds` is

    [ int_{-H/2}^{H/2} W(e) dy + 1/2 (5/6) G H gamma^2 ] ds,     W(e) = min_q psi(diag(e, q)),

with `psi` the density of the material in plane strain, of which the fibres are free to contract across, and `G` its
shear modulus. At small strain it is Simo's `1/2 (EA eps^2 + GA gamma^2 + EI kappa^2)`, with `EA = E' H`,
`EI = E' H^3 / 12`, `E' = E / (1 - nu^2)`; with the density `linear_elastic` it is that at any strain. 5/6 is the shear
coefficient of a rectangle (Reissner 1945).

A node's coordinates are `(x, y, radian * theta)`: `radian` is a length, such as the height, so that all three are
lengths, and a change of units changes nothing. The force that belongs to the third is a moment over `radian`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam import checks
from jaxbeam._rules import custom_derivative
from jaxbeam._tree import Numbers, index_field, is_concrete, namespace, pytree, replace, to_device, usual_rules
from jaxbeam.materials import POISSON, check_density, macklin_mueller
from jaxbeam.mesh import Mesh, float_nodes
from jaxbeam.terms import (
    TendonEnergy,
    Term,
    check_law,
    inverse_square_stiffness,
    polyline_length,
    tendons,
)

# Reissner's shear coefficient of a rectangular section.
SHEAR = 5 / 6
# Gauss's rule across the height. The bending of a linear material takes two points, one more is for large strains.
_HEIGHTS, _WEIGHTS = np.polynomial.legendre.leggauss(3)
# Least cosine of the angle between an element and the normal of its section at rest.
ALIGNED = 0.9


@pytree
class Line(Mesh):
    """Nodes and elements of a rod at rest, straight or curved; stress-free as it is.

    Args:
        nodes: `(n, 3)`: x, y, and `radian` times the angle of the axis, anticlockwise from x. Their dtype is the dtype
            of everything computed. May be traced.
        elements: `(m, 2)` node numbers of each element, in the direction of the axis. Always concrete.
        radian: `()` the length that stands for one radian in the third column, positive: a height, say.

    Raises:
        ValueError: if a shape or dtype is wrong, an index is out of range, a node is unused, a coordinate is not
            finite, `radian` is not positive, or an element has no length or does not run along its angle. Traced
            numbers of which that holds become NaN, and whatever is solved on them is `INVALID`.
    """

    nodes: jax.Array
    elements: np.ndarray = index_field()
    radian: jax.Array

    def __post_init__(self) -> None:
        nodes = float_nodes(self.nodes, 3, "(x, y, radian * angle)")
        radian = to_device(checks.number("radian", self.radian, checks.POSITIVE), nodes.dtype)
        elements = _checked_pairs(self.elements, nodes.shape[0])
        if is_concrete(nodes, radian):
            _check_line(np.asarray(nodes, float), elements, float(radian))
        else:
            length, along, _ = _run(nodes, elements, radian)
            nodes = checks.poisoned(jnp.asarray(nodes), jnp.all(along > ALIGNED * length))
        object.__setattr__(self, "nodes", to_device(nodes))
        object.__setattr__(self, "elements", elements)
        object.__setattr__(self, "radian", radian)


def _checked_pairs(elements: Any, total: int) -> np.ndarray:
    array = checks.whole_numbers("elements", elements, "(m, 2)", (2,))
    bad = np.flatnonzero(((array < 0) | (array >= total)).any(axis=1))
    if bad.size:
        raise ValueError(
            f"elements: element {bad[0]} is {array[bad[0]].tolist()}, but nodes are numbered 0 to {total - 1}"
        )
    unused = np.setdiff1d(np.arange(total), array)
    if unused.size:
        raise ValueError(
            f"nodes: {unused.size} belong to no element, the first is node {unused[0]}; remove them and renumber"
        )
    return array


def _run(nodes: Any, elements: np.ndarray, radian: Any) -> tuple[Any, Any, Any]:
    """Length of each element `(m,)`, how far it runs along its angle, and that angle."""
    xp = namespace(nodes, radian)
    first, second = (xp.asarray(nodes)[elements[:, k]] for k in (0, 1))
    chord, angle = (second - first)[:, :2], (first + second)[:, 2] / (2 * radian)
    return xp.sqrt(xp.sum(chord**2, axis=1)), chord[:, 0] * xp.cos(angle) + chord[:, 1] * xp.sin(angle), angle


def _check_line(nodes: np.ndarray, elements: np.ndarray, radian: float) -> None:
    wild = np.flatnonzero(~np.isfinite(nodes).all(axis=1))
    if wild.size:
        raise ValueError(f"nodes: node {wild[0]} is not finite: {nodes[wild[0]].tolist()}")
    length, along, angle = _run(nodes, elements, radian)
    bad = np.flatnonzero(~(along > ALIGNED * length))
    if bad.size:
        k = bad[0]
        chord = nodes[elements[k, 1]] - nodes[elements[k, 0]]
        turn = np.arctan2(chord[1], chord[0])
        problem = f"runs at {turn:.4g} radians, but its angle is {angle[k]:.4g}" if length[k] > 0 else "has no length"
        raise ValueError(
            f"nodes: element {k} {problem}; the third column is radian times the angle of the axis, and nodes must be "
            f"so close that it turns little from one to the next"
        )


def straight(length: Numbers, radian: Numbers, nodes: int, dtype: Any = None) -> Line:
    """A straight line of evenly spaced nodes along x, centred on the origin.

    Args:
        length: of the rod, positive; may be traced.
        radian: see `Line`; may be traced.
        nodes: how many, at least 2.
        dtype: of the nodes; by default JAX's float.

    Raises:
        ValueError: if `nodes` is not a whole number of at least 2, or a length is not positive and finite.
    """
    checks.count("nodes", nodes, 2)
    length, radian = (
        checks.number(name, value, checks.POSITIVE) for name, value in (("length", length), ("radian", radian))
    )
    dtype = checks.float_dtype("dtype", dtype)
    unit = np.linspace(-0.5, 0.5, nodes)[:, None] * [1.0, 0.0, 0.0]
    pairs = np.stack([np.arange(nodes - 1), np.arange(1, nodes)], axis=1)
    return Line(unit.astype(dtype) * namespace(length).asarray(length, dtype), pairs, to_device(radian, dtype))


# -------------------------------------------------------------------------------------------- energy


@pytree
class RodParams:
    """Parameters of rod elements (leading axis `m` in a `Term`), all differentiable.

    rest `(m, 2, 3)`: rest coordinates. radian `(m,)`: see `Line`. height `(m,)`: of the section. material: pytree of
    the density's parameters.
    """

    rest: jax.Array
    radian: jax.Array
    height: jax.Array
    material: Any


@dataclasses.dataclass(frozen=True)
class RodEnergy:
    """Energy of one element of two nodes; the strains are those at its middle. One point, and not two, lets a thin
    element bend without shear: it does not lock (Simo and Vu-Quoc 1986). Hashable, so never retraced."""

    density: Callable[[jax.Array, Any], jax.Array]

    def __call__(self, x: jax.Array, params: RodParams) -> jax.Array:
        return _element_energy(self.density, x, params)


# Jitted, so that it is traced once for all of its derivatives.
@partial(jax.jit, static_argnums=0)
def _element_energy(density: Callable[[jax.Array, Any], jax.Array], x: jax.Array, params: RodParams) -> jax.Array:
    length, (stretch, shear, curvature) = strains(x, params)
    fibres = stretch - 0.5 * params.height * jnp.asarray(_HEIGHTS, x.dtype) * curvature
    energies = jax.vmap(partial(fibre_energy, density), in_axes=(0, None))(fibres, params.material)
    stiffness = SHEAR * shear_modulus(density, params.material, x.dtype)
    along = 0.5 * jnp.sum(jnp.asarray(_WEIGHTS, x.dtype) * energies)
    return length * params.height * (along + 0.5 * stiffness * shear**2)


def strains(x: jax.Array, params: RodParams) -> tuple[jax.Array, tuple[jax.Array, jax.Array, jax.Array]]:
    """Rest length `()` of an element at `x` `(2, 3)`, and `(eps, gamma, kappa)` at its middle.

    Written in the displacement and the turn since rest, so that small strains keep their digits.
    """
    moved = x - params.rest
    chord = (params.rest[1] - params.rest[0])[:2]
    length = jnp.sqrt(jnp.sum(chord**2))
    before = 0.5 * (params.rest[0, 2] + params.rest[1, 2]) / params.radian
    turn = 0.5 * (moved[0, 2] + moved[1, 2]) / params.radian
    (along, across), (pull, shove) = (
        (jnp.cos(before) * v[0] + jnp.sin(before) * v[1], jnp.cos(before) * v[1] - jnp.sin(before) * v[0])
        for v in (chord / length, (moved[1] - moved[0])[:2] / length)
    )
    sine, cosine, less = jnp.sin(turn), jnp.cos(turn), 2 * jnp.sin(0.5 * turn) ** 2
    stretch = cosine * pull + sine * shove + sine * across - less * along
    shear = cosine * shove - sine * pull - sine * along - less * across
    return length, (stretch, shear, (moved[1, 2] - moved[0, 2]) / (params.radian * length))


def fibre_stretches(x: jax.Array, params: RodParams) -> jax.Array:
    """Stretch `(2,)` of the fibres of one element at the surfaces. Where one is not positive, sections overlap."""
    _, (stretch, _, curvature) = strains(x, params)
    half = 0.5 * params.height * curvature
    return 1 + jnp.stack([stretch - half, stretch + half])


@partial(custom_derivative, static=1)
def fibre_energy(density: Callable[[jax.Array, Any], jax.Array], e: jax.Array, material: Any) -> jax.Array:
    """`W(e) = min_q psi(diag(e, q))`: of a material stretched to `1 + e` in plane strain, free to contract across."""
    return _plain(density, e, _contraction(density, e, material), material)


@fibre_energy.defjvp
def _(
    density: Callable[[jax.Array, Any], jax.Array], primals: tuple[jax.Array, Any], tangents: tuple[jax.Array, Any]
) -> tuple[jax.Array, jax.Array]:
    # At the least energy its slope in q is zero, so q need not be differentiated here.
    q = _contraction(density, *primals)
    return jax.jvp(lambda e, material: _plain(density, e, q, material), primals, tangents)


def shear_modulus(density: Callable[[jax.Array, Any], jax.Array], material: Any, dtype: Any) -> jax.Array:
    """`G`, the second derivative at rest of the density in a simple shear."""
    zero = jnp.zeros((), dtype)
    sheared = lambda g: density(jnp.stack([jnp.stack([zero, g]), jnp.stack([zero, zero])]), material)
    return jax.grad(jax.grad(sheared))(zero)


def _plain(density: Callable[[jax.Array, Any], jax.Array], e: jax.Array, q: jax.Array, material: Any) -> jax.Array:
    zero = jnp.zeros_like(e)
    return density(jnp.stack([jnp.stack([e, zero]), jnp.stack([zero, q])]), material)


@partial(custom_derivative, static=1)
def _contraction(density: Callable[[jax.Array, Any], jax.Array], e: jax.Array, material: Any) -> jax.Array:
    """`q` at which `psi(diag(e, q))` is least, by Newton's method. Exact after one step where `psi` is quadratic."""
    force = jax.grad(partial(_plain, density), argnums=1)
    zero = jnp.zeros_like(e)
    by_e, by_q = jax.grad(force, argnums=(0, 1))(zero, zero, material)
    small = by_e / by_q * e
    # Right at small strain, and positive at any stretch, where a logarithmic density needs it.
    start = jnp.where(e < 0, -small, -small / (1 + jnp.where(e < 0, 0, small)))

    def improve(carry: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        count, q, _ = carry
        step = force(e, q, material) / jax.grad(force, argnums=1)(e, q, material)
        return count + 1, q - step, jnp.abs(step)

    # Convergence is quadratic: what follows a step of the root of eps is round-off.
    rough = float(jnp.finfo(e.dtype).eps) ** 0.5
    going = lambda carry: (carry[0] < 30) & (carry[2] > rough)
    first = (jnp.zeros((), jnp.int32), start, jnp.full_like(e, jnp.inf))
    return lax.while_loop(going, improve, first)[1]


@_contraction.defjvp
def _(
    density: Callable[[jax.Array, Any], jax.Array], primals: tuple[jax.Array, Any], tangents: tuple[jax.Array, Any]
) -> tuple[jax.Array, jax.Array]:
    (e, material), q = primals, _contraction(density, *primals)
    force = jax.grad(partial(_plain, density), argnums=1)
    change = jax.jvp(lambda e, material: force(e, q, material), primals, tangents)[1]
    return q, -change / jax.grad(force, argnums=1)(e, q, material)


@usual_rules
def rod(
    line: Line,
    height: Numbers,
    params: Any,
    density: Callable[[jax.Array, Any], jax.Array] = macklin_mueller,
) -> Term:
    """The body of a rod of rectangular section and unit thickness.

    Args:
        line: its nodes and elements; differentiable in them.
        height: of the section, positive; scalar or `(m,)`, one for each element.
        params: the density's parameters, such as `lame(young, poisson)`: a pytree whose leaves are scalars or `(m,)`.
        density: of the material in plane strain, one of `jaxbeam.materials` or your own module-level function.

    Raises:
        ValueError: if a concrete height is not positive and finite, or a parameter has another shape.
    """
    checks.instance(
        "line", line, Line, "make one with straight(length, radian, nodes) or Line(nodes, elements, radian)"
    )
    checks.function("density", density, "(H, params) -> scalar")
    total, dtype = line.elements.shape[0], line.nodes.dtype
    xp = namespace(line.nodes, line.radian, height, *jax.tree.leaves(params))

    def per_element(name: str, value: Numbers, within: checks.Range = checks.FINITE) -> jax.Array:
        values = checks.numbers(name, value, within, ((), (total,)), "one for each element")
        return xp.broadcast_to(xp.asarray(values, dtype), (total,))

    material = jax.tree_util.tree_map_with_path(
        lambda path, leaf: per_element(f"params{jax.tree_util.keystr(path)}", leaf), params
    )
    check_density(density, material)
    rest = xp.asarray(line.nodes)[line.elements]
    heights = per_element("height", height, checks.POSITIVE)
    every = RodParams(rest, per_element("radian", line.radian), heights, material)
    return Term(RodEnergy(density), line.elements, every)


# -------------------------------------------------------------------------------------------- tendons


@pytree
class Offsets:
    """Where the points of tendons are: `eccentricity` `(m, k)` along the section from its node, to the left of the
    axis, and `radian` `(m,)` as in `Line`."""

    eccentricity: jax.Array
    radian: jax.Array


def at_offsets(x: jax.Array, attachment: Offsets) -> jax.Array:
    """The points `(..., k, 2)` of a tendon at nodes `(..., k, 3)`: `(x - e sin theta, y + e cos theta)`."""
    xp = namespace(x, attachment.eccentricity, attachment.radian)
    theta = x[..., 2] / attachment.radian[..., None]
    normal = xp.stack([-xp.sin(theta), xp.cos(theta)], axis=-1)
    return x[..., :2] + attachment.eccentricity[..., None] * normal


@usual_rules
def rod_tendons(
    line: Line,
    nodes: Numbers,
    eccentricity: Numbers,
    modulus: Numbers,
    stiffness: Callable[[jax.Array, jax.Array], jax.Array] = inverse_square_stiffness,
) -> Term:
    """Tendons beside the axis of a rod, at their natural length (ratio 1); `command` shortens them.

    Args:
        line: natural lengths are measured on its rest positions, and differentiable in them.
        nodes: `(m, k)` node numbers: of the two ends of each tendon, with any guides between.
        eccentricity: distance of each point from its node, to the left of the axis; scalar or `(m, k)`; differentiable.
        modulus: as for `tendons`.
        stiffness: as for `tendons`.

    Raises:
        ValueError: if `eccentricity` has another shape or is not finite, or as `tendons` does.
    """
    # It checks the nodes and the modulus. Lengths are measured anew.
    checks.instance("line", line, Line, "on a mesh of triangles use tendons")
    plain = tendons(line, nodes, modulus, stiffness)
    eccentricity = checks.numbers(
        "eccentricity", eccentricity, shapes=((), plain.nodes.shape), each="one for each point"
    )
    dtype, xp = line.nodes.dtype, namespace(line.nodes, line.radian, eccentricity)
    offsets = Offsets(
        xp.broadcast_to(xp.asarray(eccentricity, dtype), plain.nodes.shape),
        xp.broadcast_to(xp.asarray(line.radian), plain.nodes.shape[:1]),
    )
    natural = polyline_length(at_offsets(xp.asarray(line.nodes)[plain.nodes], offsets))
    return Term(
        TendonEnergy(stiffness, at_offsets),
        plain.nodes,
        replace(plain.params, natural=natural, commanded=natural, attachment=offsets),
    )


# ------------------------------------------------------------------------------------ the hand calculation


class Estimate(NamedTuple):
    """What a hand calculation gives: `tip_angle` `()` in degrees, `lengths` and `tensions` `(2,)` of the tendons."""

    tip_angle: jax.Array
    lengths: jax.Array
    tensions: jax.Array


@usual_rules
def euler_bernoulli(
    ratios: Numbers,
    length: Numbers = 3.5,
    height: Numbers = 0.8,
    young: Numbers = 1e4,
    poisson: Numbers = 0.45,
    tendon_modulus: Numbers = 2e3,
    *,
    stiffness: Callable[[jax.Array, jax.Array], jax.Array] = inverse_square_stiffness,
) -> Estimate:
    """The tendon beam by hand: linear Euler-Bernoulli theory in plane strain, with eccentric tendons.

    Over the half with tendons the axial strain `eps` and the curvature `kappa` are constant. With `a = length / 2`,
    `e = +H/2` (top) and `-H/2` (bottom), tendon lengths `l = a (1 + eps - e kappa)` and tensions `T = k (l - l*)`,

        E' H eps + sum T = 0,     E' H^3/12 kappa - sum e T = 0,     E' = E / (1 - nu^2):

    two linear equations. The other half stays straight, so the tip rises by `kappa a^2 / 2 + kappa a a`.

    Args:
        ratios: `(2,)` of the top and the bottom tendon.
        length: of the beam.
        height: of the beam.
        young: Young's modulus, scalar. (1e4, 0.45) in `macklin_mueller` is (9962, 0.4444) at small strain.
        poisson: Poisson's ratio, scalar.
        tendon_modulus: scalar or `(2,)`.
        stiffness: the law of the tendons, see `tendons`.

    Returns:
        An `Estimate`, differentiable in every real argument.

    Raises:
        ValueError: if an argument has another shape or a concrete one is outside its range, which is that of
            `rod_beam`. Where a traced one is, the answer is NaN.
    """
    values = (
        checks.numbers("ratios", ratios, checks.POSITIVE, ((2,),), "of the top and the bottom tendon"),
        checks.number("length", length, checks.POSITIVE),
        checks.number("height", height, checks.POSITIVE),
        checks.number("young", young, checks.POSITIVE),
        checks.number("poisson", poisson, POISSON),
        checks.numbers("tendon_modulus", tendon_modulus, checks.POSITIVE, ((), (2,))),
    )
    check_law(stiffness)
    xp = namespace(*values)
    return _by_hand(*(xp.asarray(value) for value in values), stiffness)


@partial(jax.jit, static_argnames="stiffness")
def _by_hand(
    ratios: jax.Array,
    length: jax.Array,
    height: jax.Array,
    young: jax.Array,
    poisson: jax.Array,
    tendon_modulus: jax.Array,
    stiffness: Callable[[jax.Array, jax.Array], jax.Array],
) -> Estimate:
    """`euler_bernoulli` of arrays."""
    half, plane = 0.5 * length, young / (1 - poisson**2)
    commanded = ratios * half
    k = stiffness(tendon_modulus, commanded)
    # Tensions are k (a - l* + a rows . (eps, kappa)).
    rows = jnp.stack([jnp.ones(2), height * jnp.array([-0.5, 0.5])], axis=1)
    section = jnp.stack([plane * height, plane * height**3 / 12])
    matrix = jnp.diag(section) + half * (rows.T * k) @ rows
    stretch, curvature = jnp.linalg.solve(matrix, -rows.T @ (k * (half - commanded)))
    lengths = half * (1 + rows @ jnp.stack([stretch, curvature]))
    angle = jnp.rad2deg(jnp.arctan2(1.5 * curvature * half**2, length))
    return Estimate(angle, lengths, k * (lengths - commanded))
