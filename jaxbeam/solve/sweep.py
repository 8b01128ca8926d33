"""Many commands at once.

A sweep repeats work: neighbours differ by little. So each command is continued from the nearest one solved already, as
far as their tangents lead (`jaxbeam.solve.predictor`), and one or two Newton steps are left to take where a solve from
rest takes ten or twenty.

Commands are parted into chunks of near ones, by a rule that depends on nothing but the commands and the scene. A chunk
is one call of one compiled program, whatever their number, which goes through its commands from rest outward. Chunks
know nothing of each other: they run on all cores, devices and processes there are, in any order, with the same results.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import PartitionSpec

from jaxbeam.core import checks
from jaxbeam.core.compiling import compiled, usual_rules, zeros_like_result
from jaxbeam.core.tree import Numbers, is_concrete, to_device, unlock
from jaxbeam.linear.layout import Layout, expand, gather
from jaxbeam.scene.scene import Scene, command, energy, partway
from jaxbeam.scene.supports import check_held
from jaxbeam.solve.continuation import follow
from jaxbeam.solve.equilibrium import differentiable_rows
from jaxbeam.solve.newton import Newton, check_asked, topology
from jaxbeam.solve.predictor import STATES, Trail, ahead
from jaxbeam.solve.solution import Solution, Status

# Commands of a chunk, and the numbers that its states and tangents may take (half a gigabyte).
CHUNK = 128


MEMORY = 1 << 26


# How far apart (in ratios) the states are, at least, that a prediction is made from: a polynomial through nearer ones
# blows up their round-off, and that costs a Newton step.
GAP = 0.005


# Square of the sine of the angle within which two directions are one.
STRAIGHT = 1e-12


@usual_rules
def sweep(
    scene: Scene,
    ratios: Numbers,
    solver: Newton = Newton(),
    progress: Callable[[int, int], None] | None = None,
) -> Solution:
    """The equilibrium of each of many commands.

    Each is continued from the nearest of those nearer to rest that are solved already, and solved from rest where that
    fails. Where a command has several equilibria it is the one that a beam comes to whose tendons are pulled ever more;
    `ramp` follows a way of your own. One that fails harms no other.

    It runs on all cores of all local devices. Where `jax.distributed` is set up every process calls it with the same
    arguments, solves a part, and gets the whole; the results do not depend on how many there are.

    Args:
        scene: with `m` tendons.
        ratios: `(B, m)`, positive.
        solver: settings of each solve.
        progress: called with how many of this process's commands are solved and how many there are, whenever there are
            more. Not called inside jit.

    Returns:
        A `Solution` with leading axis `B`, differentiable as that of `equilibrium` is, lane by lane.

    Raises:
        ValueError: if the shape is wrong, a concrete ratio is not positive and finite, or as `equilibrium` does.
    """
    check_asked(scene, solver)
    values = checks.shaped("ratios", ratios, None)
    shape = values.shape
    if len(shape) != 2 or shape[0] == 0:
        raise ValueError(f"ratios: expected shape (B, m), a row for each command, got {shape}")
    # `is_valid` looks at traced ones.
    if is_concrete(values):
        checks.inside("ratios", values, checks.POSITIVE)
    if progress is not None:
        checks.function("progress", progress, "(solved, all)")
    check_held(scene)
    jax.eval_shape(command, scene, jax.ShapeDtypeStruct(shape[1:], scene.mesh.nodes.dtype))  # checks the count
    rows = to_device(values, scene.mesh.nodes.dtype)
    layout, open_scene = solver.linear.layout(topology(scene)), unlock(scene)
    size = min(CHUNK, max(1, MEMORY // (scene.mesh.nodes.size * (1 + shape[1]))))
    if is_concrete(rows, *jax.tree.leaves(scene)):
        return _everywhere(open_scene, layout, np.asarray(rows), size, solver, progress)
    batch = _in_one_program(*lax.stop_gradient((open_scene, layout, rows)), min(size, shape[0]), solver)
    return differentiable_rows(open_scene, layout, rows, batch, solver)


# ------------------------------------------------------------------------------------------------ one chunk


class Chunk(NamedTuple):
    """What is known in a chunk of `C` commands. The last of the `C + 1` places is the beam at rest."""

    ratios: jax.Array  # (C + 1, m)
    loaded: jax.Array  # (C + 1,) share of the dead loads: 0 at rest
    x: jax.Array  # (C + 1, n, 2) where the branch lies, closer than the solution (see `follow`)
    drift: jax.Array  # (C + 1, m, n, 2) derivative of x in each ratio
    usable: jax.Array  # (C + 1,) may be continued from
    known: jax.Array  # (C + 1,) its drift is known
    anchor: jax.Array  # (C + 1,) the place farther back on its smooth branch that is remembered; C if there is none


@compiled("solver")
def solve_chunk(scene: Scene, layout: Layout, rows: jax.Array, count: jax.Array, solver: Newton) -> Solution:
    """The equilibria of the first `count` of the commands `rows` `(C, m)`, from rest outward."""
    size, m = rows.shape
    rest = scene.mesh.nodes
    order = jnp.argsort(jnp.sum((rows - 1) ** 2, axis=1) + jnp.where(jnp.arange(size) < count, 0, jnp.inf))
    no, places = jnp.zeros(size + 1, bool), jnp.zeros((size + 1, *rest.shape), rest.dtype)
    chunk = Chunk(
        ratios=jnp.concatenate([rows, jnp.ones((1, m), rows.dtype)]),
        loaded=jnp.ones(size + 1, rest.dtype).at[-1].set(0),
        x=places.at[-1].set(rest),
        drift=jnp.zeros((size + 1, m, *rest.shape), rest.dtype),
        usable=no.at[-1].set(True),
        known=no,
        anchor=jnp.full(size + 1, size, jnp.int32),
    )
    nothing = zeros_like_result(lambda: _continue(scene, layout, chunk, order[0], chunk.anchor[0], solver))

    def one(k: jax.Array, carry: tuple[Chunk, Solution]) -> tuple[Chunk, Solution]:
        chunk, all = carry
        lane = order[k]
        nearest = _nearest(chunk, rows[lane])

        def attempt(carry: Any) -> Any:
            parent, _, _ = carry
            found = _continue(scene, layout, chunk, lane, parent, solver)
            # One that fails is begun again at rest.
            again = ((found.solution.status & ~Status.OVERLAPPING) != 0) & (parent != size)
            return jnp.where(again, size, parent), again, found

        begin = (nearest, jnp.asarray(True), nothing)
        parent, _, found = lax.while_loop(lambda c: c[1], attempt, begin)
        # A body that overlaps itself is an equilibrium to go on from.
        good = (found.solution.status & ~Status.OVERLAPPING) == 0
        back = chunk.anchor[parent]
        near = chunk.known[back] & (jnp.sum((chunk.ratios[parent] - chunk.ratios[back]) ** 2) < GAP**2)
        anchor = jnp.where(found.joined, jnp.where(near, back, parent), size)
        chunk = chunk._replace(
            x=chunk.x.at[lane].set(found.x),
            drift=chunk.drift.at[lane].set(found.drift),
            usable=chunk.usable.at[lane].set(good),
            known=chunk.known.at[lane].set(good & found.known),
            anchor=chunk.anchor.at[lane].set(anchor),
        )
        return chunk, jax.tree.map(lambda many, new: many.at[lane].set(new), all, found.solution)

    none = jax.tree.map(lambda leaf: jnp.zeros((size, *leaf.shape), leaf.dtype), nothing.solution)
    return lax.fori_loop(0, count, one, (chunk, none))[1]


class Lane(NamedTuple):
    """What comes of one command: its solution, the branch and its drift there, whether that is known, and joined to its
    parent."""

    solution: Solution
    x: jax.Array
    drift: jax.Array
    known: jax.Array
    joined: jax.Array


def _continue(scene: Scene, layout: Layout, chunk: Chunk, lane: jax.Array, parent: jax.Array, solver: Newton) -> Lane:
    """The equilibrium of a lane, continued from that of its parent."""
    ratios, here = chunk.ratios[lane], chunk.ratios[parent]
    loaded = lambda s: (1 - s) * chunk.loaded[parent] + s
    scene_at = lambda s: command(partway(scene, loaded(s)), (1 - s) * here + s * ratios)
    trail = _trail(chunk, parent, ratios)
    one = jnp.ones((), chunk.x.dtype)
    path, factor, after = follow(scene_at, layout, trail, one[None], solver, displacement=ahead(trail, one))
    found = jax.tree.map(lambda leaf: leaf[0], path)
    slope = lambda r: jax.grad(energy, argnums=1)(command(scene, r), found.x)
    pull = lambda e: gather(layout, jax.jvp(slope, (ratios,), (e,))[1])
    pulls = jax.vmap(pull, out_axes=1)(jnp.eye(len(ratios), dtype=ratios.dtype))
    moves = solver.linear.solve(layout, factor, pulls)
    drift = jax.vmap(lambda v: expand(layout, -v, found.x.shape), in_axes=1)(moves)
    known = (after.depth > 0) & jnp.all(jnp.isfinite(drift))
    return Lane(found, after.x[0], drift, known, (after.depth > 1) & (found.attempts == 1))


def _nearest(chunk: Chunk, ratios: jax.Array) -> jax.Array:
    """The place to continue from: the nearest, where one that has its anchor right behind it counts as half as far."""
    ahead, behind = ratios - chunk.ratios, chunk.ratios - chunk.ratios[chunk.anchor]
    far, along = jnp.sum(ahead**2, axis=1), jnp.sum(ahead * behind, axis=1)
    straight = chunk.known[chunk.anchor] & (along > 0) & (along**2 >= (1 - STRAIGHT) * far * jnp.sum(behind**2, axis=1))
    return jnp.argmin(jnp.where(chunk.usable, jnp.where(straight, 0.25, 1.0) * far, jnp.inf)).astype(jnp.int32)


def _trail(chunk: Chunk, parent: jax.Array, ratios: jax.Array) -> Trail:
    """The trail from the anchors that lie on the line from the parent on to `ratios`: the parent at `s = 0`."""
    direction = ratios - chunk.ratios[parent]
    length = jnp.sum(direction**2)
    places, s, fits = [parent], [jnp.zeros((), ratios.dtype)], [chunk.known[parent]]
    for _ in range(STATES - 1):
        place = chunk.anchor[places[-1]]
        back = chunk.ratios[place] - chunk.ratios[parent]
        along = jnp.sum(back * direction) / jnp.where(length > 0, length, 1)
        aside = jnp.sum((back - along * direction) ** 2)
        # Farther back by more than a hair, or the polynomial through both is ill-defined.
        behind = along < s[-1] - 0.01
        fits.append(fits[-1] & chunk.known[place] & behind & (aside <= STRAIGHT * length))
        places.append(place)
        s.append(along)
    where = jnp.stack(places)
    slopes = jnp.einsum("qmna,m->qna", chunk.drift[where], direction)
    return Trail(jnp.stack(s), chunk.x[where], slopes, jnp.sum(jnp.stack(fits), dtype=jnp.int32))


# ------------------------------------------------------------------------------------------------ many chunks


@partial(jax.jit, static_argnames=("size", "solver"))
def _in_one_program(scene: Scene, layout: Layout, rows: jax.Array, size: int, solver: Newton) -> Solution:
    """The equilibria of traced commands `rows` `(B, m)`, in chunks of consecutive ones."""
    count = len(rows)
    chunks = -(-count // size)
    padded = jnp.concatenate([rows, jnp.ones((chunks * size - count, rows.shape[1]), rows.dtype)])
    counts = jnp.minimum(size, count - size * jnp.arange(chunks))
    parts = lax.map(lambda part: solve_chunk(scene, layout, *part, solver), (padded.reshape(chunks, size, -1), counts))
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:count], parts)


@compiled("devices", "solver")
def _on_devices(
    scene: Scene,
    layout: Layout,
    rows: jax.Array,
    counts: jax.Array,
    devices: tuple[jax.Device, ...],
    solver: Newton,
) -> Solution:
    """One chunk on each device: `rows` `(D, C, m)`, of which the first `counts` `(D,)` are solved."""
    each = PartitionSpec("devices")
    one = lambda scene, layout, rows, counts: jax.tree.map(
        lambda leaf: leaf[None], solve_chunk(scene, layout, rows[0], counts[0], solver)
    )
    specs = (PartitionSpec(), PartitionSpec(), each, each)
    mesh = jax.sharding.Mesh(np.array(devices), ("devices",))
    return jax.shard_map(one, mesh=mesh, in_specs=specs, out_specs=each, check_vma=False)(scene, layout, rows, counts)


def _everywhere(
    scene: Scene,
    layout: Layout,
    rows: np.ndarray,
    size: int,
    solver: Newton,
    progress: Callable[[int, int], None] | None,
) -> Solution:
    """The equilibria of concrete commands `rows` `(B, m)`, on every core, device and process."""
    parts = _partition(rows, np.arange(len(rows)), size)
    processes, devices = jax.process_count(), tuple(jax.local_devices())
    # Where there are fewer parts than processes, one that has none solves the first for nothing: all must take part.
    mine = parts[jax.process_index() :: processes] or parts[:1]
    jobs = [mine[k : k + len(devices)] for k in range(0, len(mine), len(devices))]

    def solve(job: list[np.ndarray]) -> list[Solution]:
        chunks, counts = np.ones((len(devices), size, rows.shape[1]), rows.dtype), np.zeros(len(devices), np.int32)
        for k, part in enumerate(job):
            chunks[k, : len(part)], counts[k] = rows[part], len(part)
        found = jax.device_get(_on_devices(scene, layout, chunks, counts, devices, solver))
        return [jax.tree.map(lambda leaf, k=k: leaf[k], found) for k in range(len(job))]

    results: list[Solution] = []
    # Devices of a kind share the work by themselves; a processor's cores are one device, and each takes a job.
    workers = (os.cpu_count() or 1) if len(devices) == 1 and devices[0].platform == "cpu" else 1
    if len(jobs) > 1:
        # Nothing to do, but it compiles: each thread would.
        solve([])
    with ThreadPoolExecutor(workers) as pool:
        for found in pool.map(solve, jobs):
            results += found
            if progress is not None:
                progress(sum(len(part) for part in mine[: len(results)]), sum(len(part) for part in mine))
    everyone = results if processes == 1 else _gathered(results, len(parts))
    return _assembled(parts, everyone)


def _gathered(mine: list[Solution], count: int) -> list[Solution]:
    """The solutions of all `count` parts, from those of this process and of the others."""
    from jax.experimental import multihost_utils

    processes = jax.process_count()
    most = -(-count // processes)
    # Every process must bring as many; what is too much is not looked at.
    padded = mine + [mine[-1]] * (most - len(mine))
    everyone = multihost_utils.process_allgather(jax.tree.map(lambda *leaves: np.stack(leaves), *padded))
    return [jax.tree.map(lambda leaf, k=k: leaf[k % processes, k // processes], everyone) for k in range(count)]


def _assembled(parts: list[np.ndarray], results: list[Solution]) -> Solution:
    """The solutions of all parts, in the order in which the commands were given."""
    order = np.argsort(np.concatenate(parts))
    join = lambda *leaves: to_device(
        np.concatenate([leaf[: len(part)] for leaf, part in zip(leaves, parts, strict=True)])[order]
    )
    return jax.tree.map(join, *results)


def _partition(rows: np.ndarray, lanes: np.ndarray, size: int) -> list[np.ndarray]:
    """Lanes in groups of at most `size`, near to each other: the widest coordinate is halved until they fit."""
    if len(lanes) <= size:
        return [lanes]
    axis = np.argmax(np.ptp(rows[lanes], axis=0))
    ordered = lanes[np.argsort(rows[lanes, axis], kind="stable")]
    middle = -(-len(lanes) // (2 * size)) * size
    return _partition(rows, ordered[:middle], size) + _partition(rows, ordered[middle:], size)
