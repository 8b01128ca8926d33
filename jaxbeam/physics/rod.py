"""Planar rods: slender beams whose nodes carry a position and the angle of their section.

A rod is a line of nodes with rigid sections (Reissner, J. Appl. Math. Phys. 23 (1972), 795-804; Simo, Comput. Methods
Appl. Mech. Eng. 49 (1985), 55-70). `r(s)` is the axis, `s` the arc length at rest, and `theta` the angle of the
section's normal, anticlockwise from x. The strains are

    Gamma = R(theta)^T r' = (1 + eps, gamma),     kappa = theta',

with `eps` the stretch of the axis, `gamma` the shear and `kappa` the curvature. Their values at rest are subtracted. A
fibre at the height `y` has the stretch

    1 + e = 1 + eps - y kappa.

The energy of a length `ds` is

    [ int_{-H/2}^{H/2} W(e) dy + 1/2 (5/6) G H gamma^2 ] ds,     W(e) = min_q psi(diag(e, q)),

with `H` the height, `psi` the energy density of the material in plane strain, and `G` its shear modulus. The minimum
means that fibres are free to contract across the height. 5/6 is the shear coefficient of a rectangle (Reissner 1945).
At small strain the energy is Simo's

    1/2 (EA eps^2 + GA gamma^2 + EI kappa^2) ds,     EA = E' H,     EI = E' H^3 / 12,     E' = E / (1 - nu^2).

With the density `linear_elastic` it is that at any strain.

The coordinates of a node are `(x, y, radian * theta)`. `radian` is a length, such as the height, so that all three
coordinates are lengths, and a change of units changes nothing. The force conjugate to the third coordinate is a moment
divided by `radian`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxbeam.core import checks
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.derivative import custom_derivative
from jaxbeam.core.tree import Numbers, namespace, pytree
from jaxbeam.mesh.line import Line, beside
from jaxbeam.mesh.mesh import Mesh
from jaxbeam.mesh.refinement import Finer
from jaxbeam.physics.energy import Energy, NotRefinable, Term
from jaxbeam.physics.materials import check_density, macklin_mueller, material_is_valid

# Reissner's shear coefficient of a rectangular section.
SHEAR = 5 / 6

# Gauss's rule across the height. Bending of a linear material needs two points. The third is for large strains.
_HEIGHTS, _WEIGHTS = np.polynomial.legendre.leggauss(3)


# -------------------------------------------------------------------------------------------- energy


@pytree
class RodParams:
    """Parameters of `m` rod elements, all differentiable.

    rest: `(m, 2, 3)` rest coordinates of the two nodes.
    radian: `(m,)` see `Line`.
    height: `(m,)` height of the section.
    material: pytree of the density's parameters with leading axis `m`.
    """

    rest: jax.Array
    radian: jax.Array
    height: jax.Array
    material: Any


@dataclasses.dataclass(frozen=True)
class RodEnergy(Energy):
    """Energy of one element of two nodes, with the strains at its middle.

    With one integration point instead of two, a thin element can bend without shear, so it does not lock (Simo and
    Vu-Quoc 1986). The margin, which must stay positive, is the smallest stretch of its fibres.
    """

    density: Callable[[jax.Array, Any], jax.Array]
    name: ClassVar[str] = "rod"
    body: ClassVar[bool] = True
    coordinates: ClassVar[int | None] = 3

    def __call__(self, x: jax.Array, params: RodParams) -> jax.Array:
        return _element_energy(self.density, x, params)

    def valid(self, params: RodParams) -> jax.Array:
        return jnp.all((params.height > 0) & (params.radian > 0)) & material_is_valid(params.material)

    def margin(self, x: jax.Array, params: RodParams) -> jax.Array:
        return jnp.min(jax.vmap(fibre_stretches)(x, params), axis=1)

    def refined(self, term: Term, mesh: Mesh, finer: Finer) -> Term:
        raise NotRefinable("a rod has the error of its model, which no finer mesh shows")

    def sides(self, x: jax.Array, params: RodParams) -> list[jax.Array]:
        return [beside(x, jnp.tile(half * params.height[:, None], 2), params.radian) for half in (0.5, -0.5)]


# Jitted, so that it is traced only once for all of its derivatives.
@partial(jax.jit, static_argnums=0)
def _element_energy(density: Callable[[jax.Array, Any], jax.Array], x: jax.Array, params: RodParams) -> jax.Array:
    length, (stretch, shear, curvature) = strains(x, params)
    fibres = stretch - 0.5 * params.height * jnp.asarray(_HEIGHTS, x.dtype) * curvature
    energies = jax.vmap(partial(fibre_energy, density), in_axes=(0, None))(fibres, params.material)
    stiffness = SHEAR * shear_modulus(density, params.material, x.dtype)
    along = 0.5 * jnp.sum(jnp.asarray(_WEIGHTS, x.dtype) * energies)
    return length * params.height * (along + 0.5 * stiffness * shear**2)


def strains(x: jax.Array, params: RodParams) -> tuple[jax.Array, tuple[jax.Array, jax.Array, jax.Array]]:
    """Rest length `()` of an element with coordinates `x` `(2, 3)`, and `(eps, gamma, kappa)` at its middle.

    Computed from the displacements and the rotation since rest, so that small strains keep their digits.
    """
    moved = x - params.rest
    chord = (params.rest[1] - params.rest[0])[:2]
    length = jnp.sqrt(jnp.sum(chord**2))
    rest_angle = 0.5 * (params.rest[0, 2] + params.rest[1, 2]) / params.radian
    turn = 0.5 * (moved[0, 2] + moved[1, 2]) / params.radian
    # In the frame of the section at rest: `r'` at rest is (along, across), and its change is (pull, shove).
    (along, across), (pull, shove) = (
        (
            jnp.cos(rest_angle) * v[0] + jnp.sin(rest_angle) * v[1],
            jnp.cos(rest_angle) * v[1] - jnp.sin(rest_angle) * v[0],
        )
        for v in (chord / length, (moved[1] - moved[0])[:2] / length)
    )
    sine, cosine, one_minus_cosine = jnp.sin(turn), jnp.cos(turn), 2 * jnp.sin(0.5 * turn) ** 2
    stretch = cosine * pull + sine * shove + sine * across - one_minus_cosine * along
    shear = cosine * shove - sine * pull - sine * along - one_minus_cosine * across
    return length, (stretch, shear, (moved[1, 2] - moved[0, 2]) / (params.radian * length))


def fibre_stretches(x: jax.Array, params: RodParams) -> jax.Array:
    """Stretch `(2,)` of the fibres at the two faces of one element. If one is not positive, sections overlap."""
    _, (stretch, _, curvature) = strains(x, params)
    half = 0.5 * params.height * curvature
    return 1 + jnp.stack([stretch - half, stretch + half])


@partial(custom_derivative, static=1)
def fibre_energy(density: Callable[[jax.Array, Any], jax.Array], e: jax.Array, material: Any) -> jax.Array:
    """`W(e) = min_q psi(diag(e, q))`: energy density of a fibre of stretch `1 + e`, free to contract across."""
    return _diagonal_density(density, e, _contraction(density, e, material), material)


@fibre_energy.defjvp
def _(
    density: Callable[[jax.Array, Any], jax.Array], primals: tuple[jax.Array, Any], tangents: tuple[jax.Array, Any]
) -> tuple[jax.Array, jax.Array]:
    # The derivative in q is zero at the minimum, so q is held fixed here.
    q = _contraction(density, *primals)
    return jax.jvp(lambda e, material: _diagonal_density(density, e, q, material), primals, tangents)


def shear_modulus(density: Callable[[jax.Array, Any], jax.Array], material: Any, dtype: Any) -> jax.Array:
    """Shear modulus `G`: the second derivative of the density in a simple shear, at rest."""
    zero = jnp.zeros((), dtype)
    sheared = lambda g: density(jnp.stack([jnp.stack([zero, g]), jnp.stack([zero, zero])]), material)
    return jax.grad(jax.grad(sheared))(zero)


def _diagonal_density(
    density: Callable[[jax.Array, Any], jax.Array], e: jax.Array, q: jax.Array, material: Any
) -> jax.Array:
    """`psi(diag(e, q))`."""
    zero = jnp.zeros_like(e)
    return density(jnp.stack([jnp.stack([e, zero]), jnp.stack([zero, q])]), material)


@partial(custom_derivative, static=1)
def _contraction(density: Callable[[jax.Array, Any], jax.Array], e: jax.Array, material: Any) -> jax.Array:
    """The `q` that minimises `psi(diag(e, q))`, by Newton's method. One step is exact if `psi` is quadratic."""
    force = jax.grad(partial(_diagonal_density, density), argnums=1)
    zero = jnp.zeros_like(e)
    by_e, by_q = jax.grad(force, argnums=(0, 1))(zero, zero, material)
    small = by_e / by_q * e
    # The start is right at small strain, and has `1 + q > 0` at any stretch, as a logarithmic density needs.
    start = jnp.where(small < 0, -small, -small / (1 + jnp.maximum(small, 0)))

    def improve(carry: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        count, q, _ = carry
        step = force(e, q, material) / jax.grad(force, argnums=1)(e, q, material)
        return count + 1, q - step, jnp.abs(step)

    # Convergence is quadratic: after a step shorter than the square root of eps, the error is round-off.
    rough = float(jnp.finfo(e.dtype).eps) ** 0.5
    going = lambda carry: (carry[0] < 30) & (carry[2] > rough)
    first = (jnp.zeros((), jnp.int32), start, jnp.full_like(e, jnp.inf))
    return lax.while_loop(going, improve, first)[1]


@_contraction.defjvp
def _(
    density: Callable[[jax.Array, Any], jax.Array], primals: tuple[jax.Array, Any], tangents: tuple[jax.Array, Any]
) -> tuple[jax.Array, jax.Array]:
    (e, material), q = primals, _contraction(density, *primals)
    force = jax.grad(partial(_diagonal_density, density), argnums=1)
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
        line: nodes and elements of the axis; differentiable in the nodes.
        height: height of the section, positive; scalar or `(m,)`, one for each element.
        params: the density's parameters, such as `lame(young, poisson)`: a pytree whose leaves are scalars or `(m,)`.
        density: energy density in plane strain, one of `jaxbeam.physics.materials` or your own module-level function.

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
