"""Elastic energy densities in plane strain, as pure functions of the displacement gradient.

Each takes `Lame` parameters and `H = F - I` `(2, 2)`, with `F` the deformation gradient. It returns the energy per unit
rest volume (units of Young's modulus; thickness is 1). The formulas are evaluated in `H`, so that small strains keep
their digits: `J - 1` is `tr H + det H`, and `distortion_and_volume` evaluates `(|F|^2 - 2) / 2 - (J - 1)`. All are
differentiable to any order in `H` and in the parameters.

Use `neo_hookean` where measured constants are to hold at small strain. `macklin_mueller` is the default and that of the
reference scene. It is finite for inverted elements, and with `lame_macklin_mueller` it has the constants that it is
given. `saint_venant_kirchhoff` and `linear_elastic` are for small strains, to compare with other codes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core.checks import POSITIVE, Range, function, numbers, scalar
from jaxbeam.core.compiling import usual_rules
from jaxbeam.core.tree import Numbers, is_concrete, namespace, pytree, to_device

# Range of Poisson's ratio of a stable material.
POISSON = Range("a value in (-1, 0.5)", "a value in (-1, 0.5)", low=-1, high=0.5)


@pytree
class Lame:
    """Lame parameters, in the unit of Young's modulus.

    mu: `()` or `(t,)`, one for each element: shear modulus.
    lam: `()` or `(t,)`: first Lame parameter.
    """

    mu: jax.Array
    lam: jax.Array


@usual_rules
def lame(young: Numbers, poisson: Numbers) -> Lame:
    """Lame parameters of linear isotropic elasticity (any textbook, e.g. Bonet and Wood 2008, eq. 6.33).

    Args:
        young: Young's modulus, positive; scalar or `(t,)`, one for each element.
        poisson: Poisson's ratio in (-1, 0.5); scalar or `(t,)`. Above 0.47 triangles of three nodes lock: use six.

    The moduli are those that a pull at small strain shows with every density but `macklin_mueller`, the default of
    `solid`, which needs `lame_macklin_mueller` for that.

    Returns:
        `mu = E / (2 (1 + nu))`, `lam = E nu / ((1 + nu)(1 - 2 nu))`, differentiable in both.

    Raises:
        ValueError: if concrete values are outside their range, or both are arrays of different shapes. A traced value
            outside its range becomes NaN.
    """
    E = numbers("young", young, POSITIVE, why="a stiffness is positive")
    incompressible = "0.5 is incompressible, where lam is infinite: use 0.49, and triangles of six nodes"
    nu = numbers("poisson", poisson, POISSON, why=incompressible)
    if () not in (E.shape, nu.shape) and E.shape != nu.shape:
        raise ValueError(f"poisson: expected a scalar or the shape of young, {E.shape}, got {nu.shape}")
    xp, dtype = namespace(E, nu), jnp.result_type(float)
    E, nu = xp.asarray(E, dtype), xp.asarray(nu, dtype)
    return Lame(to_device(E / (2 * (1 + nu))), to_device(E * nu / ((1 + nu) * (1 - 2 * nu))))


@usual_rules
def lame_macklin_mueller(young: Numbers, poisson: Numbers) -> Lame:
    """Parameters that make `macklin_mueller` behave as (young, poisson) at small strain.

    Its linearisation has shear modulus `mu` and first parameter `lam - mu`, so `lam` is raised by `mu`.
    With the plain `lame`, (1e4, 0.45) behaves as `E = 9962, nu = 0.4444`, (1e4, 0.3) as `8974, 0.167`, and
    at `nu = 0` the in-plane bulk modulus vanishes. Arguments and errors as for `lame`.
    """
    plain = lame(young, poisson)
    return Lame(plain.mu, plain.lam + plain.mu)


def material_is_valid(material: Any) -> Any:
    """Whether the parameters of a material are in their range, `()`, for traced `Lame` parameters.

    The range of other parameters is not known, so they pass.
    """
    if not isinstance(material, Lame):
        return True
    # 3 lam + 2 mu = E / (1 - 2 nu). If mu > 0, this is positive if and only if nu is in (-1, 0.5).
    return jnp.all((material.mu > 0) & (3 * material.lam + 2 * material.mu > 0))


def distortion_and_volume(H: jax.Array) -> tuple[jax.Array, jax.Array]:
    """`(|F|^2 - 2) / 2 - (J - 1)` and `J - 1`.

    The first is zero if `F` is a rotation times a uniform stretch. It is evaluated as half a sum of squares. Evaluated
    term by term, it would lose the digits of a small strain in a body that rotates.
    """
    # Index each entry only once, because every derivative repeats the indexing.
    a, b, c, d = H[0, 0], H[0, 1], H[1, 0], H[1, 1]
    return 0.5 * ((a - d) ** 2 + (b + c) ** 2), a + d + (a * d - b * c)


def macklin_mueller(H: jax.Array, params: Lame) -> jax.Array:
    """Stable neo-Hookean, `mu/2 (|F|^2 - 2) - mu (J - 1) + lam/2 (J - 1)^2`.

    Finite for every `F`, also an inverted one, so the smallest `J` must be checked separately. Linearised, its first
    Lame parameter is `lam - mu`: see `lame_macklin_mueller`.

    Source: Macklin and Mueller, "A constraint-based formulation of stable neo-Hookean materials", MIG 2021.
    """
    distortion, volume = distortion_and_volume(H)
    return params.mu * distortion + 0.5 * params.lam * volume**2


def neo_hookean(H: jax.Array, params: Lame) -> jax.Array:
    """Classical compressible neo-Hookean, `mu/2 (|F|^2 - 2) - mu ln J + lam/2 (ln J)^2`.

    Domain `J > 0`; infinite as `J -> 0`, NaN below. Exact at small strain.

    Source: Bonet and Wood, "Nonlinear Continuum Mechanics for Finite Element Analysis", 2008, eq. 6.27.
    """
    distortion, volume = distortion_and_volume(H)
    log_j = jnp.log1p(volume)
    return params.mu * (distortion + _less_log1p(volume)) + 0.5 * params.lam * log_j**2


@jax.custom_jvp
def _less_log1p(v: jax.Array) -> jax.Array:
    """`v - ln(1 + v)`, about `v^2 / 2`, without the cancellation that would lose the digits of small strains.

    With `s = v / (2 + v)`, `ln(1 + v) = 2 atanh s` and `v - 2 s = s v`. So the result is

        s v - 2 (s^3/3 + s^5/5 + ...).
    """
    small = jnp.abs(v) < 0.25
    w = jnp.where(small, v, 0)
    s = w / (2 + w)
    t, series = s * s, jnp.zeros_like(v)
    for k in range(17, 1, -2):
        series = t * (1 / k + series)
    return jnp.where(small, s * (w - 2 * series), v - jnp.log1p(v))


@_less_log1p.defjvp
def _(primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    (v,), (dv,) = primals, tangents
    return _less_log1p(v), v / (1 + v) * dv


def saint_venant_kirchhoff(H: jax.Array, params: Lame) -> jax.Array:
    """Saint Venant-Kirchhoff, `mu E:E + lam/2 (tr E)^2` with the Green strain `E = (H + H^T + H^T H)/2`.

    For large rotations and small strains. Under strong compression it softens and inverts without resistance.

    Source: Bonet and Wood 2008, eq. 6.28.
    """
    # Not `H.T @ H`: mapped over elements, a product of small matrices is far slower than its loops over entries.
    strain = 0.5 * (H + H.T + jnp.sum(H[:, :, None] * H[:, None, :], axis=0))
    return params.mu * jnp.sum(strain * strain) + 0.5 * params.lam * jnp.trace(strain) ** 2


def linear_elastic(H: jax.Array, params: Lame) -> jax.Array:
    """Linear elasticity, `mu e:e + lam/2 (tr e)^2` with `e = (H + H^T)/2`: small rotations and strains only."""
    strain = 0.5 * (H + H.T)
    return params.mu * jnp.sum(strain * strain) + 0.5 * params.lam * jnp.trace(strain) ** 2


# --------------------------------------------------------------------------------- densities written by users


_PROVIDED = (macklin_mueller, neo_hookean, saint_venant_kirchhoff, linear_elastic)


def check_density(density: Callable[[jax.Array, Any], jax.Array], material: Any) -> None:
    """Refuse a density that returns no scalar, or that is written in `F` although its argument is `H = F - I`.

    The density is evaluated at a few `H`, with the parameters of the first element. This is done once for each density
    and parameters. Traced parameters are replaced by 1.

    Args:
        density: energy density of a solid or a rod.
        material: its parameters, with an entry for each element.

    Raises:
        ValueError: if the value is not a scalar or is not finite at rest, `H = 0`, or the density is written in `F`.
    """
    function("density", density, "(H, params) -> scalar")
    if density in _PROVIDED:
        if not all(hasattr(getattr(material, name, None), "shape") for name in ("mu", "lam")):
            raise ValueError(
                f"params: expected the mu and lam of {density.__name__}, such as lame(young, poisson), got {material!r}"
            )
        return
    leaves, structure = jax.tree.flatten(material)
    first = tuple(np.asarray(leaf)[0] if is_concrete(leaf) else np.ones(leaf.shape[1:], leaf.dtype) for leaf in leaves)
    known = tuple((leaf.dtype.str, leaf.shape, np.asarray(leaf).tobytes()) for leaf in first)
    _check_user_density(density, structure, known)


@lru_cache(maxsize=64)
def _check_user_density(density: Callable[[jax.Array, Any], jax.Array], structure: Any, known: tuple[Any, ...]) -> None:
    """The check of `check_density`, with the parameters of one element in a hashable form.

    Args:
        density: as for `check_density`.
        structure: pytree structure of the parameters.
        known: dtype, shape and bytes of each leaf.
    """
    leaves = [np.frombuffer(data, dtype).reshape(shape) for dtype, shape, data in known]
    material = jax.tree.unflatten(structure, leaves)
    dtype = leaves[0].dtype if leaves else jnp.result_type(float)
    scalar("density", "(H, params)", density, jax.ShapeDtypeStruct((2, 2), dtype), material)
    one, turn, strained = np.eye(2), _rotation(1.0), np.array([[1.3, 0.2], [-0.1, 0.9]])
    states = np.stack([0 * one, turn - one, one, strained, turn @ strained]).astype(dtype)
    try:
        with jax.ensure_compile_time_eval():
            found = _energies(density, states, material)
    except FloatingPointError:
        # Raised for a NaN if `jax_debug_nans` is set.
        found = np.full(len(states), np.nan)
    if not is_concrete(found):
        return
    rest, turned, unit, before, after = np.asarray(found).tolist()
    # A density in F keeps its value if a rotation multiplies its argument. A density in H keeps its value if a rotation
    # multiplies H + I.
    same = lambda a, b: abs(a - b) <= 1e3 * float(jnp.finfo(dtype).eps) * (abs(a) + abs(b) + abs(rest - unit))
    in_f = same(before, after) and not same(rest, turned) and unit < rest
    if in_f or not np.isfinite(rest):
        raise ValueError(
            f"density: expected the energy of H = F - I, the displacement gradient, 0 at rest; got one that is "
            f"{rest:g} at H = 0 and {unit:g} at H = I, so it seems to be written in F; begin it with F = H + jnp.eye(2)"
        )


@partial(jax.jit, static_argnums=0)
def _energies(density: Callable[[jax.Array, Any], jax.Array], states: jax.Array, material: Any) -> jax.Array:
    return jax.vmap(lambda H: density(H, material))(states)


def _rotation(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
