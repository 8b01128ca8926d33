"""The energies of jaxbeam written anew, from raw arrays, by code that shares nothing with the package.

In the most direct form: in the deformation gradient `F` and not in `H = F - I`, shape functions differentiated by JAX,
always in float64. Positions are taken from the first node, so that it does not matter where the body lies. Forces and
Hessians follow by automatic differentiation. What acts on the body is in `tests/actions.py` and `tests/obstacles.py`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse

from tests.actions import Action, DeadLoads, Stencils, Support, Tendons
from tests.geometry import SIDES, determinants, volumes
from tests.obstacles import Contact

EPS = float(np.finfo(np.float64).eps)


@dataclasses.dataclass(frozen=True)
class Problem:
    """A scene as raw arrays: `n` nodes, `t` elements, groups of tendons, and what else acts on it.

    nodes: `(n, 2)`, of a rod `(n, 3)`. elements: `(t, 3)` or `(t, 6)`, of a rod `(t, 2)`. fixed: like `nodes`.
    young, poisson: `(t,)` or scalars. corrected: whether `lam` is raised by `mu`. load: dead forces like `nodes`.
    actions: all other kinds, after the tendons and the load.
    height, radian: of the section of a rod, and the length that stands for a radian in the third column.
    """

    nodes: np.ndarray
    elements: np.ndarray
    fixed: np.ndarray
    young: Any
    poisson: Any
    material: str
    tendons: tuple[Tendons, ...]
    corrected: bool = False
    load: np.ndarray | None = None
    height: float = 0.0
    radian: float = 1.0
    actions: tuple[Action, ...] = ()

    @property
    def is_rod(self) -> bool:
        return np.shape(self.elements)[1] == 2

    @property
    def size(self) -> float:
        """Of the body: its largest extent at rest."""
        return float(np.ptp(np.asarray(self.nodes, np.float64)[:, :2], axis=0).max())

    @cached_property
    def rest(self) -> np.ndarray:
        """Rest positions in float64, from the first node."""
        return self.relative(self.nodes)

    def relative(self, x: np.ndarray) -> np.ndarray:
        """Positions from the first node at rest. The third column of a rod is an angle, and stays."""
        x, origin = np.array(x, np.float64), np.array(self.nodes, np.float64)[0]
        x[:, :2] -= origin[:2]
        return x

    @cached_property
    def lame(self) -> tuple[np.ndarray, np.ndarray]:
        """`mu` and `lam` of each element."""
        count = len(self.elements)
        young, poisson = (np.broadcast_to(np.asarray(v, np.float64), count) for v in (self.young, self.poisson))
        mu = young / 2 / (1 + poisson)
        return mu, 2 * mu * poisson / (1 - 2 * poisson) + (mu if self.corrected else 0)

    @cached_property
    def body(self) -> Stencils:
        """The elements."""
        elements, (mu, lam) = np.asarray(self.elements), self.lame
        corners = self.rest[elements]
        if self.is_rod:
            section = [np.full(len(elements), float(value)) for value in (self.radian, self.height)]
            return Stencils(rod_of(self.material), elements, (corners, *section, mu, lam))
        return Stencils(element_of(self.material), elements, (corners, mu, lam))

    @cached_property
    def acting(self) -> list[tuple[Action, Any]]:
        """All that acts on the body, in the order of commands, and what each is made of."""
        load = () if self.load is None else (DeadLoads(self.load),)
        return [(action, action.attached(self)) for action in (*self.tendons, *load, *self.actions)]

    @property
    def has_loads(self) -> bool:
        return any(action.rest is None for action, _ in self.acting)

    @cached_property
    def rest_commands(self) -> np.ndarray:
        """The commands `(m,)` at which what is commanded does nothing."""
        return np.concatenate([np.zeros(0), *(np.full(a.count, a.rest) for a, _ in self.acting if a.count)])

    @cached_property
    def held(self) -> np.ndarray:
        """Coordinates `(n, d)` that are fixed or that a support moves."""
        return np.any([self.fixed, *(a.held(self) for a in self.actions if isinstance(a, Support))], axis=0)

    def commanded(self, ratios: np.ndarray) -> Iterator[tuple[Action, Any, np.ndarray]]:
        """Each that acts, what it is made of, and those of the commands `(m,)` that are its own."""
        start, ratios = 0, np.asarray(ratios, np.float64)
        for action, attached in self.acting:
            yield action, attached, ratios[start : start + action.count]
            start += action.count

    def displacements(self, ratios: np.ndarray) -> np.ndarray:
        """Where supports move coordinates `(n, d)`; zero for the others."""
        moves = (c[0] * a.motions(self) for a, _, c in self.commanded(ratios) if isinstance(a, Support))
        return sum(moves, np.zeros(np.shape(self.nodes)))

    def stencils(self, ratios: np.ndarray, loaded: float = 1.0) -> list[Stencils]:
        """All that stores energy under the commands `(m,)`, with a share of the dead loads."""
        found = [self.body]
        for action, attached, commands in self.commanded(ratios):
            if attached is not None:
                nodes, params = attached
                last = np.broadcast_to(commands if action.count else loaded, len(nodes)).astype(np.float64)
                found.append(Stencils(action.energy, nodes, (*params, last), action.force))
        return found

    def contacts(self, ratios: np.ndarray) -> list[tuple[Contact, float]]:
        """Obstacles, and how far each is moved."""
        return [(a, float(c[0])) for a, _, c in self.commanded(ratios) if isinstance(a, Contact)]


# ------------------------------------------------------------------------------------------------ solids


def density(F: jax.Array, mu: jax.Array, lam: jax.Array, material: str) -> jax.Array:
    """Energy per area at rest, from the deformation gradient `F` `(2, 2)`."""
    J, C = jnp.linalg.det(F), F.T @ F
    if material == "macklin_mueller":
        return mu / 2 * (jnp.trace(C) - 2) - mu * (J - 1) + lam / 2 * (J - 1) ** 2
    if material == "neo_hookean":
        return mu / 2 * (jnp.trace(C) - 2) - mu * jnp.log(J) + lam / 2 * jnp.log(J) ** 2
    strain = {"saint_venant_kirchhoff": (C - jnp.eye(2)) / 2, "linear_elastic": (F + F.T) / 2 - jnp.eye(2)}[material]
    return mu * jnp.trace(strain @ strain) + lam / 2 * jnp.trace(strain) ** 2


def shapes(l: jax.Array, count: int) -> jax.Array:  # noqa: E741
    """Values of the shape functions at barycentric coordinates `(1 - l[0] - l[1], l[0], l[1])`."""
    l = jnp.stack([1 - l[0] - l[1], l[0], l[1]])  # noqa: E741
    if count == 3:
        return l
    return jnp.concatenate([l * (2 * l - 1), jnp.stack([4 * l[a] * l[b] for a, b in SIDES])])


@lru_cache
def element_of(material: str) -> Callable[..., jax.Array]:
    """The energy of a triangle: one point of quadrature for three nodes, three points of degree 2 for six."""

    def energy(x: jax.Array, rest: jax.Array, mu: jax.Array, lam: jax.Array) -> jax.Array:
        points = [[1 / 3, 1 / 3]] if len(x) == 3 else [[1 / 6, 1 / 6], [2 / 3, 1 / 6], [1 / 6, 2 / 3]]
        total = 0.0
        for point in points:
            by = jax.jacfwd(shapes)(jnp.array(point), len(x))
            map_ = (rest - rest[0]).T @ by
            F = (x - x[0]).T @ by @ jnp.linalg.inv(map_)
            total += jnp.linalg.det(map_) / 2 * density(F, mu, lam, material)
        return total / len(points)

    return energy


# ------------------------------------------------------------------------------------------------- rods


def fibre(a: jax.Array, mu: jax.Array, lam: jax.Array, material: str) -> jax.Array:
    """Energy of a fibre stretched to `a` whose stress across vanishes, by the stretch `b` across in closed form.

    For `neo_hookean` `u = ln b` solves `mu (exp 2u - 1) + lam (ln a + u) = 0`, which is convex in `u`: Newton's method
    from the right of the root. Two more steps, which are differentiated, make its first two derivatives exact.
    """
    if material == "macklin_mueller":
        b = (lam + mu) * a / (mu + lam * a**2)
    elif material == "linear_elastic":
        b = 1 - lam / (lam + 2 * mu) * (a - 1)
    else:
        assert material == "neo_hookean", material
        step = lambda u, a: u - (mu * jnp.expm1(2 * u) + lam * (jnp.log(a) + u)) / (2 * mu * jnp.exp(2 * u) + lam)
        fixed = jax.lax.stop_gradient(a)
        u = jax.lax.fori_loop(0, 40, lambda _, u: step(u, fixed), jnp.maximum(0.0, -jnp.log(fixed)))
        b = jnp.exp(step(step(jax.lax.stop_gradient(u), a), a))
    return density(jnp.diag(jnp.stack([a, b])), mu, lam, material)


@lru_cache
def rod_of(material: str) -> Callable[..., jax.Array]:
    """The energy of an element of a rod: fibres at three heights, and shear with the coefficient 5/6."""

    def energy(x: Any, rest: Any, radian: Any, height: Any, mu: Any, lam: Any) -> jax.Array:
        (eps, gamma, kappa), length = rod_strains(x, rest, radian)
        along = 0.0
        for place, share in ((-(0.6**0.5), 5 / 18), (0.0, 8 / 18), (0.6**0.5, 5 / 18)):
            along += share * fibre(1 + eps - place * height / 2 * kappa, mu, lam, material)
        return length * height * (along + 0.5 * 5 / 6 * mu * gamma**2)

    return energy


def rod_strains(x: Any, rest: Any, radian: Any) -> tuple[tuple[Any, Any, Any], Any]:
    """`(eps, gamma, kappa)` at the middle of an element with nodes `x` `(2, 3)`, less those at rest; its length."""

    def local(y: Any, length: Any) -> Any:
        angle = (y[0, 2] + y[1, 2]) / 2 / radian
        dx, dy = (y[1, 0] - y[0, 0]) / length, (y[1, 1] - y[0, 1]) / length
        c, s = jnp.cos(angle), jnp.sin(angle)
        return c * dx + s * dy, c * dy - s * dx, (y[1, 2] - y[0, 2]) / radian / length

    length = jnp.hypot(rest[1, 0] - rest[0, 0], rest[1, 1] - rest[0, 1])
    pairs = zip(local(x, length), local(rest, length), strict=True)
    eps, gamma, kappa = (now - before for now, before in pairs)
    return (eps, gamma, kappa), length


@jax.jit
def _fibres(x: jax.Array, rest: jax.Array, radian: jax.Array, height: jax.Array) -> jax.Array:
    def one(x: Any, rest: Any, radian: Any, height: Any) -> jax.Array:
        (eps, _, kappa), _ = rod_strains(x, rest, radian)
        return 1 + eps - jnp.abs(height / 2 * kappa)

    return jax.vmap(one)(x, rest, radian, height)


# --------------------------------------------------------------------------------------- all of it at x


@partial(jax.jit, static_argnames=("energy", "force"))
def _derivatives(energy: Any, force: Any, x: jax.Array, params: Any) -> Any:
    """Energies and gradients of stencils, and their Hessians."""
    force = force or jax.grad(energy)
    return tuple(jax.vmap(each)(x, *params) for each in (energy, force, jax.jacfwd(force)))


@partial(jax.jit, static_argnames=("energy", "force"))
def _by_command(energy: Any, force: Any, x: jax.Array, params: Any) -> jax.Array:
    """Derivatives `(m, k, d)` of the gradients of stencils in their last parameter."""
    return jax.vmap(jax.jacfwd(force or jax.grad(energy), argnums=len(params)))(x, *params)


def total_energy(x: jax.Array, stencils: list[Stencils]) -> jax.Array:
    """Energy of all stencils at positions `x` `(n, d)` from the first node."""
    return sum(jnp.sum(jax.vmap(s.energy)(x[s.nodes], *s.params)) for s in stencils)


class Facts(NamedTuple):
    """What is true at `x`.

    energy_scale and scale_sum are sums of magnitudes, over all coordinates. scale is the largest sum of magnitudes of
    the forces at one free coordinate, stiffest the largest diagonal entry of the Hessian there, and longest_row the
    largest Euclidean length of a row of it. gradient and hessian are over free coordinates, and rows are the rows of
    the Hessian there, over all coordinates. volumes are the least `J` of each element and bounds under it, of a rod the
    least stretch of a fibre; heights `(t,)` those of elements at rest.
    """

    energy: float
    energy_scale: float
    cancelled: float
    unbalanced: float
    gradient: np.ndarray
    scale: float
    scale_sum: float
    rows: scipy.sparse.csr_array
    hessian: np.ndarray | None
    stiffest: float
    longest_row: float
    volumes: np.ndarray
    bounds: np.ndarray
    heights: np.ndarray


def facts(problem: Problem, ratios: np.ndarray, x: np.ndarray, dense: bool = True, loaded: float = 1.0) -> Facts:
    """Energy, forces and, if asked for, the dense Hessian at `x` `(n, d)`."""
    return facts_from_first(problem, ratios, problem.relative(x), dense, loaded)


def facts_from_first(
    problem: Problem, ratios: np.ndarray, y: np.ndarray, dense: bool = True, loaded: float = 1.0
) -> Facts:
    """The same at positions `y` `(n, d)` from the first node."""
    d, free = y.shape[1], ~problem.held.ravel()
    gradient, scale = np.zeros(y.shape), np.zeros(y.shape)
    sparse = scipy.sparse.csr_array((y.size, y.size))
    energy = energy_scale = 0.0
    for kind in problem.stencils(ratios, loaded):
        found = _derivatives(kind.energy, kind.force, y[kind.nodes], kind.params)
        energies, gradients, hessians = jax.tree.map(np.asarray, found)
        energy, energy_scale = energy + energies.sum(), energy_scale + np.abs(energies).sum()
        np.add.at(gradient, kind.nodes, gradients)
        np.add.at(scale, kind.nodes, np.abs(gradients))
        unknowns = (d * kind.nodes[..., None] + np.arange(d)).reshape(len(kind.nodes), -1)
        hessians = hessians.reshape(-1, *unknowns.shape[1:] * 2)
        places = [np.broadcast_to(each, hessians.shape).ravel() for each in (unknowns[:, :, None], unknowns[:, None])]
        sparse = sparse + scipy.sparse.coo_array((hessians.ravel(), places), sparse.shape).tocsr()
    least, bounds, heights, cancelled = _shape(problem, y)
    gradient, sparse = gradient.ravel()[free], sparse[free]
    square = sparse[:, free]
    return Facts(
        energy=float(energy),
        energy_scale=float(energy_scale),
        cancelled=cancelled,
        unbalanced=float(np.abs(gradient).max()),
        gradient=gradient,
        scale=float(scale.ravel()[free].max()),
        scale_sum=float(scale.sum()),
        rows=sparse,
        hessian=square.toarray() if dense else None,
        stiffest=float(np.abs(square.diagonal()).max()),
        longest_row=float(np.sqrt(np.asarray(sparse.multiply(sparse).sum(axis=1))).max()),
        volumes=least,
        bounds=bounds,
        heights=heights,
    )


def _shape(problem: Problem, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Least `J` of elements, bounds under it, their heights, and the round-off of an energy in `F`."""
    elements, (mu, lam) = np.asarray(problem.elements), problem.lame
    corners, rest = y[elements], problem.rest[elements]
    if problem.is_rod:
        each = lambda value: np.full(len(elements), float(value))
        least = bounds = np.asarray(_fibres(corners, rest, each(problem.radian), each(problem.height)))
        areas = np.linalg.norm(rest[:, 1, :2] - rest[:, 0, :2], axis=1) * problem.height
        heights = np.minimum(areas / problem.height, problem.height)
    else:
        least, bounds = volumes(corners, rest)
        areas = determinants(rest, np.full((1, 3), 1 / 3))[:, 0]
        straight = rest[:, :3] - np.roll(rest[:, :3], 1, axis=1)
        heights = areas / np.linalg.norm(straight, axis=2).max(axis=1)
    return least, bounds, heights, 16 * EPS * float(np.sum((2 * mu + np.abs(lam)) * areas * (1 + np.abs(least))))


def command_forces(problem: Problem, ratios: np.ndarray, x: np.ndarray, rows: Any) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives in the commands: `(f, m)` of the gradient over the `f` free coordinates, and `(n, d, m)` of the held
    coordinates. `rows` are those of `Facts`."""
    y, free = problem.relative(x), ~problem.held.ravel()
    columns, moves = [np.zeros((int(free.sum()), 0))], [np.zeros((*y.shape, 0))]
    for action, attached, commands in problem.commanded(ratios):
        column, moved = np.zeros((2, *y.shape, action.count))
        if isinstance(action, Support):
            moved[..., 0] = action.motions(problem)
            columns.append(rows @ moved.reshape(-1, 1))
        elif action.count:
            nodes, params = attached
            params = (*params, np.broadcast_to(commands, len(nodes)))
            change = np.asarray(_by_command(action.energy, action.force, y[nodes], params))
            own = np.arange(len(nodes)) if action.count == len(nodes) else np.zeros(len(nodes), int)
            np.add.at(column, (nodes, slice(None), own[:, None]), change)
            columns.append(column.reshape(-1, action.count)[free])
        moves.append(moved)
    return np.concatenate(columns, axis=1), np.concatenate(moves, axis=2)
