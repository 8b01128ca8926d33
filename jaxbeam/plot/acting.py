"""What acts on a body from outside, in numbers: where arrows, springs and obstacles lie in each state of a picture.

All forces of a picture have one scale. Forces per length, which are in another unit, have one of their own.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxbeam.core.compiling import COMPILER_OPTIONS, one_program, usual_rules
from jaxbeam.mesh.element import edge_functions, edge_slopes
from jaxbeam.mesh.surface import CORNER
from jaxbeam.physics.energy import Term
from jaxbeam.plot.lines import clearance, extremes, inside, outline, segments
from jaxbeam.plot.springs import Springs
from jaxbeam.scene.scene import Scene, command

# Lengths relative to the extent of the body: the longest arrow of a force, the longest one of a row, the distance of
# arrows in a row, and the gap between a row of arrows along the surface and the surface.
ARROW, ROW, SPACING, GAP = 0.1, 0.06, 0.04, 0.015
# How much of the distance to the next part of the body, as across a cavity, the longest arrow of a row takes. The
# distance is the quantile of those of all arrows: at the ends of a cavity some are short.
ROOM, QUANTILE = 0.33, 0.2
# Cosine of the angle between force and surface normal below which arrows lie along the surface.
ALONG = 0.3
# How much of an obstacle limits of axes hold, relative to the body: it is looked for up to this far away, and shown
# between these depths.
REACH, SHALLOW, DEEP = 0.2, 0.02, 0.08
# Number of points for which the distance from an obstacle is computed in one go.
CHUNK = 8192

Distance = Callable[[np.ndarray], np.ndarray]


class Row(NamedTuple):
    """Arrows evenly spaced along one smooth run of edges of a term: on its stencils `(r,)`, at `xi` `(r,)` of each."""

    term: int
    stencils: tuple[int, ...]
    xi: tuple[float, ...]


class Acted(NamedTuple):
    """One state of a picture: where the body is, and what acts on it.

    scene: under the commands of this state.
    x: `(n, d)` positions.
    at, force: `(q, 2)` each: the forces on points.
    rows: for each row the points, the forces per length and the outward normals, `(r, 2)` each.
    """

    scene: Scene
    x: np.ndarray
    at: np.ndarray
    force: np.ndarray
    rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]]


class Acting:
    """What acts on a body in the states of a picture: arrows, springs and obstacles.

    Show each state to `see` before it is drawn. Arrows then have one scale, and springs one base, for all states that
    were seen. A state that is seen later can only make the arrows shorter.

    Args:
        scene: of the body.

    The attribute `scales` `(2,)` holds the length of the arrow of a unit force, and that of a unit force per length;
    infinite if there is none. `to_one_scale` makes them the same in several.
    """

    def __init__(self, scene: Scene) -> None:
        rest = np.asarray(scene.mesh.nodes)
        self.scene, self.rest, self.edges = scene, rest[:, :2], outline(scene)
        self.size = float(np.ptp(self.rest, axis=0).max())
        shape = usual_rules(jax.eval_shape)
        has = lambda of, at: [k for k, term in enumerate(scene.terms) if shape(of, term, at) is not None]
        self.loaded = has(_point_loads, rest)
        pushed = has(
            lambda term, x: term.kind.edge_loads(x[term.nodes], term.params, np.full(len(term.nodes), 0.5)), rest
        )
        self.rows = [row for k in pushed for row in _rows(k, scene.terms[k], rest, SPACING * self.size)]
        of = {k: [row for row in self.rows if row.term == k] for k in pushed}
        join = lambda each: tuple(itertools.chain(*each))
        self.joined = tuple(Row(k, join(r.stencils for r in rows), join(r.xi for r in rows)) for k, rows in of.items())
        self.rigid = has(_distance, np.zeros((1, 2), rest.dtype))
        self.springs = Springs(scene, self.rest, self.edges)
        self.scales = np.full(2, np.inf)

    @property
    def any(self) -> bool:
        """Whether anything acts, so that states must be seen."""
        return bool(self.loaded or self.rows or self.rigid or len(self.springs.nodes))

    def see(self, scene: Scene, x: np.ndarray) -> Acted:
        """What acts in a state: the scene under the commands of this state, and positions `(n, d)`."""
        found, along = _forces(scene, x, tuple(self.loaded), self.joined) if self.loaded or self.rows else ([], [])
        at, force = np.concatenate([np.zeros((0, 2, 2)), *found]).swapaxes(0, 1)
        ends = np.cumsum([len(row.xi) for row in self.rows])
        loads = np.split(np.concatenate([np.zeros((0, 2)), *along]), ends[:-1])
        rows = [self._row(x, row, load) for row, load in zip(self.rows, loads, strict=False)]
        state = Acted(scene, x, at, force, rows)
        self._rescale(state)
        self.springs.see(x)
        return state

    def see_all(self, commands: np.ndarray, x: np.ndarray) -> list[Acted]:
        """The states with commands `(s, m)` and positions `(s, n, d)`."""
        scenes = [command(self.scene, row) for row in commands] if self.any else [self.scene] * len(x)
        return [self.see(scene, here) for scene, here in zip(scenes, x, strict=True)]

    def _row(self, x: np.ndarray, row: Row, load: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        nodes, xi = self.scene.terms[row.term].nodes[list(row.stencils)], np.array(row.xi)
        ends, k = x[nodes, :2], nodes.shape[1]
        along = np.einsum("mk,mkd->md", edge_slopes(k, xi), ends)
        outward = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
        return np.einsum("mk,mkd->md", edge_functions(k, xi), ends), load, outward

    def _rescale(self, state: Acted) -> None:
        """Shorten the arrows if the longest one of a force, or of a row, is now longer than it may be."""
        most = np.linalg.norm(state.force, axis=1).max(initial=0.0)
        rooms = [(0, ARROW * self.size, most)]
        for at, load, outward in state.rows:
            clear = ROOM * _quantile(clearance(at, outward, segments(state.x, self.edges)))
            rooms.append((1, min(ROW * self.size, clear), np.linalg.norm(load, axis=1).max()))
        for k, room, most in rooms:
            self.scales[k] = min(self.scales[k], room / most if most > 0 else np.inf)

    @property
    def names(self) -> list[str]:
        """What to call the terms that have an arrow in some state."""
        drawn = [self.loaded, [row.term for row in self.rows]]
        some = [k for terms, scale in zip(drawn, self.scales, strict=True) if np.isfinite(scale) for k in terms]
        return list(dict.fromkeys(self.scene.terms[k].kind.name for k in some))

    def arrows(self, state: Acted) -> np.ndarray:
        """Arrows `(q, 2, 2)` of the forces on points: tail and head of each that is not zero.

        The tail is at the point where the force acts, or the head if less of the arrow then lies in the body.
        """
        at, force = state.at, state.force
        some = force.any(axis=1)
        at, long = at[some], self.scales[0] * force[some] if some.any() else force[some]
        if not len(at) or self.scene.mesh.is_line:
            return np.stack([at, at + long], axis=1)
        samples = np.array([0.3, 0.6, 0.95])[:, None, None] * long
        pulled, pushed = (inside(at + sign * samples, segments(state.x, self.edges)).sum(axis=0) for sign in (1, -1))
        tails = at - np.where((pushed < pulled)[:, None], long, 0)
        return np.stack([tails, tails + long], axis=1)

    def combs(self, state: Acted) -> list[tuple[np.ndarray, np.ndarray]]:
        """For each row its arrows `(r, 2, 2)`, and the points `(r, 2)` of the line that joins them.

        The arrows lie outside the body: heads at the surface where the force pushes, tails where it pulls. They are
        joined if all push or all pull. Of arrows along the surface every other one is left out, so that there are
        gaps between them.
        """
        found = []
        for at, force, outward in state.rows:
            norm = np.linalg.norm(force, axis=1, keepdims=True)
            some = norm[:, 0] > 0
            if not some.any():
                continue
            normal, long = np.sum(force * outward, axis=1, keepdims=True), self.scales[1] * force
            pushes = normal < 0
            if np.abs(normal).sum() < ALONG * norm.sum():
                tails, some[1::2] = at - 0.5 * long + GAP * self.size * outward, False
            else:
                tails = np.where(pushes, at - long, at)
            plain = some.all() and (pushes.all() or not pushes.any())
            joined = np.where(pushes, tails, tails + long) if plain else np.zeros((0, 2))
            found.append((np.stack([tails, tails + long], axis=1)[some], joined))
        return found

    def obstacles(self, state: Acted) -> list[Distance]:
        """For each obstacle the distance from it, a function of points `(..., 2)`."""
        return [partial(_distances, state.scene.terms[k], state.x.dtype) for k in self.rigid]

    def extremes(self, states: Sequence[Acted]) -> list[np.ndarray]:
        """Points `(..., 2)` that span all of this in these states; of obstacles, what is near."""
        if not self.any:
            return []
        found = [self.springs.bases, *self._rims(states)]
        for state in states:
            found += [self.arrows(state), *(arrows for arrows, _ in self.combs(state))]
        return found

    def _rims(self, states: Sequence[Acted]) -> list[np.ndarray]:
        """Points of each obstacle a little inside its boundary, straight beside, below or above the body."""
        if not self.rigid:
            return []
        body = np.concatenate([p.reshape(-1, 2) for p in extremes(self.scene, np.stack([s.x for s in states]))])
        low, high = body.min(axis=0), body.max(axis=0)
        size = (high - low).max()
        grid = np.meshgrid(*np.linspace(low - REACH * size, high + REACH * size, 61).T)
        points = np.stack([each.ravel() for each in grid], axis=1)
        beside = ((low <= points) & (points <= high)).any(axis=1)
        depths = [-distance(points) / size for state in states for distance in self.obstacles(state)]
        return [points[beside & (depth > SHALLOW) & (depth < DEEP)] for depth in depths]


def to_one_scale(each: Sequence[Acting]) -> Sequence[Acting]:
    """Set the arrows of several bodies to the smallest of their scales."""
    scales = np.min([acting.scales for acting in each], axis=0)
    for acting in each:
        acting.scales = scales
    return each


def _point_loads(term: Term, x: jax.Array) -> jax.Array | None:
    return term.kind.point_loads(x[term.nodes], term.params)


# One program for each topology: called one by one, the operations took most of the time of a moved picture.
@usual_rules
@partial(jax.jit, static_argnums=(2, 3), compiler_options=COMPILER_OPTIONS)
def _forces(scene: Scene, x: jax.Array, loaded: tuple[int, ...], rows: tuple[Row, ...]) -> tuple[list[Any], list[Any]]:
    """The outer forces `(q, 2, 2)` of each loaded term, and the forces per length `(r, 2)` on each row."""
    on_rows = []
    for row in rows:
        term, stencils = scene.terms[row.term], np.array(row.stencils)
        params = jax.tree.map(lambda leaf, stencils=stencils: leaf[stencils], term.params)
        on_rows.append(term.kind.edge_loads(x[term.nodes[stencils]], params, np.array(row.xi)))
    return [_point_loads(scene.terms[k], x) for k in loaded], on_rows


@one_program
def _distance(term: Term, points: jax.Array) -> jax.Array | None:
    """Distances `(p,)` of points `(p, 2)` from the obstacle of a term; None if it has none."""
    return term.kind.obstacle(points, term.params)


def _distances(term: Term, dtype: Any, points: np.ndarray) -> np.ndarray:
    """Distances of points `(..., 2)`, some at a time, so that one program serves grids of all shapes."""
    flat = points.reshape(-1, 2).astype(dtype)
    padded: Any = np.pad(flat, ((0, -len(flat) % CHUNK), (0, 0)), mode="edge").reshape(-1, CHUNK, 2)
    found = np.concatenate([np.asarray(_distance(term, part)) for part in padded])
    return found[: len(flat)].reshape(points.shape[:-1])


def _rows(number: int, term: Term, rest: np.ndarray, spacing: float) -> list[Row]:
    """The rows of arrows of a term: one for each run of its edges that has no corner."""
    starts, ends = np.asarray(term.nodes)[:, :2].T
    chords = rest[ends, :2] - rest[starts, :2]
    length = np.linalg.norm(chords, axis=1)
    at_end = {node: k for k, node in enumerate(ends.tolist())}
    before = [at_end.get(node, -1) for node in starts.tolist()]
    smooth = [p >= 0 and chords[k] @ chords[p] > CORNER * length[k] * length[p] for k, p in enumerate(before)]
    following = {p: k for k, p in enumerate(before) if smooth[k]}
    left, found = set(range(len(starts))), []
    for start in [*(k for k in range(len(starts)) if not smooth[k]), *range(len(starts))]:  # then the closed runs
        run, k = [], start
        while k in left:
            left.remove(k)
            run.append(k)
            k = following.get(k, -1)
        if not run:
            continue
        passed = np.cumsum([0.0, *length[run]])
        count = max(1, round(passed[-1] / spacing))
        # Arrows at both ends of an open line; at a corner they would cross those of the next run.
        free = before[run[0]] < 0 and ends[run[-1]] not in starts
        s = passed[-1] * (np.linspace(0, 1, count + 1) if free else (np.arange(count) + 0.5) / count)
        where = np.clip(np.searchsorted(passed, s, side="right") - 1, 0, len(run) - 1)
        stencils = np.array(run)[where]
        xi = (s - passed[where]) / length[stencils]
        found.append(Row(number, tuple(stencils.tolist()), tuple(xi.tolist())))
    return found


def _quantile(lengths: np.ndarray) -> float:
    return float(np.sort(lengths)[int(QUANTILE * len(lengths))])  # np.quantile turns infinite ones into NaN
