"""Sweeps: the equilibria of many commands.

Neighbouring commands have similar equilibria. So each command is continued from the nearest one that is solved already,
with the tangent there as predictor (`jaxbeam.solve.predictor`). This takes one or two Newton steps; a solve from rest
takes ten or twenty.

Commands are divided into chunks of neighbours, by a rule that depends on the commands and the scene alone. One compiled
program solves a chunk of any number of commands, from rest outward. Chunks are independent: they run on all cores,
devices and processes, in any order, with the same results.

Use `ramp` where the order of commands matters, because a sweep follows no path, and `corrected` where each answer needs
an error bar.
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
from jaxbeam.core.progress import Progress, Report, check_progress
from jaxbeam.core.tree import Numbers, T, is_concrete, to_device, unlock
from jaxbeam.linear.layout import Layout, expand, gather
from jaxbeam.scene.evaluation import energy
from jaxbeam.scene.rigid import check_held
from jaxbeam.scene.scene import Scene, at_places, check_commands, command, has_supports, partway, rest_commands
from jaxbeam.solve.continuation import follow
from jaxbeam.solve.equilibrium import differentiable_rows
from jaxbeam.solve.newton import Newton, check_scene_and_solver, topology
from jaxbeam.solve.predictor import STATES, Trail, predict
from jaxbeam.solve.solution import Solution, Status, outlined

# The most commands in a chunk.
CHUNK = 128

# The most numbers in the positions and tangents of a chunk: half a gigabyte in float64.
MEMORY = 1 << 26

# The least distance (in ratios) between states that a prediction is made from. A polynomial through nearer ones
# amplifies their round-off, and that costs a Newton step.
GAP = 0.005

# Two directions count as one if the square of the sine of the angle between them is below this.
STRAIGHT = 1e-12


@usual_rules
def sweep(
    scene: Scene,
    ratios: Numbers,
    solver: Newton = Newton(),
    progress: bool | Callable[[int, int], None] | None = None,
) -> Solution:
    """The equilibrium of each of many commands.

    Each command is continued from the nearest one that is closer to rest and solved already. If that fails, it is
    solved from rest. Where a command has several equilibria, the sweep finds the one that a beam reaches when its
    tendons are shortened monotonically; `ramp` follows the straight path to one command. A command that fails does not
    affect the others.

    A sweep runs on all cores of all local devices. Under `jax.distributed` every process calls `sweep` with the same
    arguments, solves a part of the commands, and gets all results. These do not depend on the number of processes.

    Args:
        scene: with `m` tendons.
        ratios: `(B, m)`, positive.
        solver: settings of each solve.
        progress: `True` draws a line of progress on stderr, if that is a terminal. A function is called after each
            chunk, as `progress(solved, all)`, with the number of commands that this process has solved and the number
            of all its commands. Inside jit there is no progress.

    Returns:
        A `Solution` with leading axis `B`, differentiable like that of `equilibrium`.

    Raises:
        ValueError: if the shape is wrong, a concrete ratio is not positive and finite, or as `equilibrium` does.
    """
    check_scene_and_solver(scene, solver)
    values = checks.shaped("ratios", ratios, None)
    shape = values.shape
    if len(shape) != 2 or shape[0] == 0:
        raise ValueError(f"ratios: expected shape (B, m), a row for each command, got {shape}")
    check_progress(progress, "(solved, all)")
    check_held(scene)
    jax.eval_shape(command, scene, jax.ShapeDtypeStruct(shape[1:], scene.mesh.nodes.dtype))  # checks the count
    check_commands("ratios", scene, values)
    rows = to_device(values, scene.mesh.nodes.dtype)
    layout, open_scene = solver.linear.layout(topology(scene)), unlock(scene)
    size = min(CHUNK, max(1, MEMORY // (scene.mesh.nodes.size * (1 + shape[1]))))
    if is_concrete(rows, *jax.tree.leaves(scene)):
        return outlined(_on_all_cores(open_scene, layout, np.asarray(rows), size, solver, progress), scene.mesh)
    batch = _in_one_program(*lax.stop_gradient((open_scene, layout, rows)), min(size, shape[0]), solver)
    return outlined(differentiable_rows(open_scene, layout, rows, batch, solver), scene.mesh)


# ------------------------------------------------------------------------------------------------ one chunk


class Chunk(NamedTuple):
    """States of a chunk of `C` commands: an entry for each command, and one with index `C` for the beam at rest.

    ratios: `(C + 1, m)` commands.
    loaded: `(C + 1,)` share of the loads that acts: 0 at rest, 1 elsewhere.
    x: `(C + 1, n, d)` positions, with the last Newton step added (see `Continuation.accepted`).
    tangent: `(C + 1, m, n, d)` derivative of the positions in each ratio.
    usable: `(C + 1,)` whether other commands may be continued from the entry.
    known: `(C + 1,)` whether the tangent is known.
    previous: `(C + 1,)` index of an entry closer to rest on the same smooth branch; `C` if there is none.
    """

    ratios: jax.Array
    loaded: jax.Array
    x: jax.Array
    tangent: jax.Array
    usable: jax.Array
    known: jax.Array
    previous: jax.Array


class Continued(NamedTuple):
    """The result for one command.

    solution: its solution.
    x: `(n, d)` positions, with the last Newton step added.
    tangent: `(m, n, d)` derivative of the positions in each ratio.
    known: `()` whether the tangent is known.
    joined: `()` whether the solution lies on the same smooth branch as the entry that it was continued from.
    """

    solution: Solution
    x: jax.Array
    tangent: jax.Array
    known: jax.Array
    joined: jax.Array


@compiled("solver")
def solve_chunk(scene: Scene, layout: Layout, rows: jax.Array, count: jax.Array, solver: Newton) -> Solution:
    """The equilibria of the commands of a chunk, solved from rest outward.

    Args:
        scene: with `m` tendons and unlocked indices.
        layout: of its matrix.
        rows: `(C, m)` commands.
        count: `()` how many of them, from the first on, are solved.
        solver: settings.

    Returns:
        The solutions, with leading axis `C`; zeros after the first `count`.
    """
    size = len(rows)
    distance = jnp.sum((rows - rest_commands(scene)) ** 2, axis=1)
    order = jnp.argsort(distance + jnp.where(jnp.arange(size) < count, 0, jnp.inf))
    chunk = _at_rest(scene, rows)
    zeros = zeros_like_result(lambda: _continue(scene, layout, chunk, order[0], chunk.previous[0], solver))

    def solve_next(k: jax.Array, carry: tuple[Chunk, Solution]) -> tuple[Chunk, Solution]:
        chunk, solutions = carry
        index = order[k]

        def attempt(carry: Any) -> Any:
            parent, _, _ = carry
            found = _continue(scene, layout, chunk, index, parent, solver)
            # A command that fails is tried again from rest.
            again = ~_is_good(found.solution) & (parent != size)
            return jnp.where(again, size, parent), again, found

        begin = (_nearest(chunk, rows[index]), jnp.asarray(True), zeros)
        parent, _, found = lax.while_loop(lambda carry: carry[1], attempt, begin)
        solutions = jax.tree.map(lambda all, new: all.at[index].set(new), solutions, found.solution)
        return _entered(chunk, index, parent, found), solutions

    none = jax.tree.map(lambda leaf: jnp.zeros((size, *leaf.shape), leaf.dtype), zeros.solution)
    return lax.fori_loop(0, count, solve_next, (chunk, none))[1]


def _at_rest(scene: Scene, rows: jax.Array) -> Chunk:
    """A chunk of the commands `rows` `(C, m)` of which none is solved: only the entry at rest is usable."""
    size, m = rows.shape
    rest = scene.mesh.nodes
    no, zeros = jnp.zeros(size + 1, bool), jnp.zeros((size + 1, *rest.shape), rest.dtype)
    return Chunk(
        ratios=jnp.concatenate([rows, rest_commands(scene)[None]]),
        loaded=jnp.ones(size + 1, rest.dtype).at[-1].set(0),
        x=zeros.at[-1].set(rest),
        tangent=jnp.zeros((size + 1, m, *rest.shape), rest.dtype),
        usable=no.at[-1].set(True),
        known=no,
        previous=jnp.full(size + 1, size, jnp.int32),
    )


def _is_good(solution: Solution) -> jax.Array:
    """Whether other commands may be continued from a solution, `()`. One that overlaps itself is an equilibrium too."""
    return (solution.status & ~Status.OVERLAPPING) == 0


def _entered(chunk: Chunk, index: jax.Array, parent: jax.Array, found: Continued) -> Chunk:
    """The chunk with the result of the command `index` `()`, which was continued from the entry `parent` `()`."""
    good, size = _is_good(found.solution), len(chunk.ratios) - 1
    before = chunk.previous[parent]
    # The parent is skipped if it is too near to the entry before it.
    near = chunk.known[before] & (jnp.sum((chunk.ratios[parent] - chunk.ratios[before]) ** 2) < GAP**2)
    previous = jnp.where(found.joined, jnp.where(near, before, parent), size)
    return chunk._replace(
        x=chunk.x.at[index].set(found.x),
        tangent=chunk.tangent.at[index].set(found.tangent),
        usable=chunk.usable.at[index].set(good),
        known=chunk.known.at[index].set(good & found.known),
        previous=chunk.previous.at[index].set(previous),
    )


def _continue(
    scene: Scene, layout: Layout, chunk: Chunk, index: jax.Array, parent: jax.Array, solver: Newton
) -> Continued:
    """The equilibrium of the command `index` `()`, continued from the solved entry `parent` `()` of the chunk, and its
    derivative in the ratios, from which later commands are predicted."""
    ratios, start = chunk.ratios[index], chunk.ratios[parent]
    loaded = lambda s: (1 - s) * chunk.loaded[parent] + s
    scene_at = lambda s: command(partway(scene, loaded(s)), (1 - s) * start + s * ratios)
    trail = _trail(chunk, parent, ratios)
    one = jnp.ones((), chunk.x.dtype)
    path, factor, after = follow(scene_at, layout, trail, one[None], solver, displacement=predict(trail, one))
    found = jax.tree.map(lambda leaf: leaf[0], path)
    placed = lambda r: at_places(command(scene, r), found.x)
    gradient = lambda r: jax.grad(energy, argnums=1)(command(scene, r), placed(r))
    # `dx/dr = -K^-1 dg/dr`, one column for each ratio.
    load = lambda direction: gather(layout, jax.jvp(gradient, (ratios,), (direction,))[1])
    loads = jax.vmap(load, out_axes=1)(jnp.eye(len(ratios), dtype=ratios.dtype))
    moves = solver.linear.solve(layout, factor, loads)
    tangent = jax.vmap(lambda move: expand(layout, -move, found.x.shape), in_axes=1)(moves)
    if has_supports(scene):
        tangent += jnp.moveaxis(jax.jacfwd(placed)(ratios), -1, 0)
    known = (after.depth > 0) & jnp.all(jnp.isfinite(tangent))
    return Continued(found, after.x[0], tangent, known, (after.depth > 1) & (found.attempts == 1))


def _nearest(chunk: Chunk, ratios: jax.Array) -> jax.Array:
    """Index `()` of the entry that the command `ratios` `(m,)` is continued from: the nearest usable one.

    The distance of an entry counts half if its previous entry lies behind it on the line to `ratios`, because the
    predictor has two states then.
    """
    onward, back = ratios - chunk.ratios, chunk.ratios - chunk.ratios[chunk.previous]
    distance, along = jnp.sum(onward**2, axis=1), jnp.sum(onward * back, axis=1)
    straight = along**2 >= (1 - STRAIGHT) * distance * jnp.sum(back**2, axis=1)
    straight = chunk.known[chunk.previous] & (along > 0) & straight
    weighted = jnp.where(straight, 0.25, 1.0) * distance
    return jnp.argmin(jnp.where(chunk.usable, weighted, jnp.inf)).astype(jnp.int32)


def _trail(chunk: Chunk, parent: jax.Array, ratios: jax.Array) -> Trail:
    """The trail from the entry `parent` `()`, at `s = 0`, to the command `ratios` `(m,)`, at `s = 1`.

    Behind the parent come its previous entries, up to the first that does not lie on the line to `ratios`.
    """
    direction = ratios - chunk.ratios[parent]
    length = jnp.sum(direction**2)
    entries, s, fits = [parent], [jnp.zeros((), ratios.dtype)], [chunk.known[parent]]
    for _ in range(STATES - 1):
        entry = chunk.previous[entries[-1]]
        back = chunk.ratios[entry] - chunk.ratios[parent]
        along = jnp.sum(back * direction) / jnp.where(length > 0, length, 1)
        across = jnp.sum((back - along * direction) ** 2)
        # Each entry must lie at least a hundredth of the step behind the one before, or the polynomial through both is
        # ill-conditioned.
        behind = along < s[-1] - 0.01
        fits.append(fits[-1] & chunk.known[entry] & behind & (across <= STRAIGHT * length))
        entries.append(entry)
        s.append(along)
    where = jnp.stack(entries)
    slopes = jnp.einsum("qmna,m->qna", chunk.tangent[where], direction)
    return Trail(jnp.stack(s), chunk.x[where], slopes, jnp.sum(jnp.stack(fits), dtype=jnp.int32))


# ------------------------------------------------------------------------------------------------ many chunks


@partial(jax.jit, static_argnames=("size", "solver"))
def _in_one_program(scene: Scene, layout: Layout, rows: jax.Array, size: int, solver: Newton) -> Solution:
    """The equilibria of traced commands `rows` `(B, m)`, in chunks of `size` consecutive ones."""
    count = len(rows)
    chunks = -(-count // size)
    spare = np.tile(rest_commands(scene), (chunks * size - count, 1))
    padded = jnp.concatenate([rows, spare])
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
    """One chunk on each of `D` devices: commands `rows` `(D, C, m)`, of which the first `counts` `(D,)` are solved."""
    each = PartitionSpec("devices")
    one = lambda scene, layout, rows, counts: jax.tree.map(
        lambda leaf: leaf[None], solve_chunk(scene, layout, rows[0], counts[0], solver)
    )
    specs = (PartitionSpec(), PartitionSpec(), each, each)
    mesh = jax.sharding.Mesh(np.array(devices), ("devices",))
    return jax.shard_map(one, mesh=mesh, in_specs=specs, out_specs=each, check_vma=False)(scene, layout, rows, counts)


def _on_all_cores(
    scene: Scene,
    layout: Layout,
    rows: np.ndarray,
    size: int,
    solver: Newton,
    progress: Progress,
) -> Solution:
    """The equilibria of concrete commands `rows` `(B, m)`, on every core, device and process."""
    parts = partition(rows, np.arange(len(rows)), size)
    processes, devices = jax.process_count(), tuple(jax.local_devices())
    # All processes must take part. If there are fewer parts than processes, a process without one solves the first part
    # again.
    mine = parts[jax.process_index() :: processes] or parts[:1]
    jobs = [mine[k : k + len(devices)] for k in range(0, len(mine), len(devices))]

    def solve(job: list[np.ndarray]) -> list[Solution]:
        chunks, counts = np.tile(rest_commands(scene), (len(devices), size, 1)), np.zeros(len(devices), np.int32)
        for k, part in enumerate(job):
            chunks[k, : len(part)], counts[k] = rows[part], len(part)
        found = jax.device_get(_on_devices(scene, layout, chunks, counts, devices, solver))
        return [jax.tree.map(lambda leaf, k=k: leaf[k], found) for k in range(len(job))]

    results: list[Solution] = []
    # Several devices solve the chunks of one job together. To JAX the cores of a processor are a single device. There
    # each core gets a thread, which solves one job after the other.
    workers = (os.cpu_count() or 1) if len(devices) == 1 and devices[0].platform == "cpu" else 1
    total = sum(map(len, mine))
    unit = "commands" if processes == 1 else "commands of this process"
    with Report(progress, unit, total) as report, ThreadPoolExecutor(workers) as pool:
        if len(jobs) > 1:
            # An empty job compiles the program once; otherwise each thread would compile it.
            solve([])
        for found in pool.map(solve, jobs):
            results += found
            solved = sum(map(len, mine[: len(results)]))
            report(solved, call=(solved, total))
    return assembled(parts, results if processes == 1 else _gathered(results, len(parts)))


def _gathered(mine: list[Solution], count: int) -> list[Solution]:
    """The solutions of all `count` parts, from those of this process and of the others."""
    from jax.experimental import multihost_utils

    processes = jax.process_count()
    most = -(-count // processes)
    # Every process must contribute the same number; the surplus is ignored.
    padded = mine + [mine[-1]] * (most - len(mine))
    everyone = multihost_utils.process_allgather(jax.tree.map(lambda *leaves: np.stack(leaves), *padded))
    return [jax.tree.map(lambda leaf, k=k: leaf[k % processes, k // processes], everyone) for k in range(count)]


def assembled(parts: list[np.ndarray], results: list[T]) -> T:
    """The results of all parts, each padded to the same length, in the order of the commands that were passed."""
    order = np.argsort(np.concatenate(parts))
    join = lambda *leaves: to_device(
        np.concatenate([leaf[: len(part)] for leaf, part in zip(leaves, parts, strict=True)])[order]
    )
    return jax.tree.map(join, *results)


def partition(rows: np.ndarray, indices: np.ndarray, size: int) -> list[np.ndarray]:
    """Divide commands into chunks of at most `size` neighbours.

    They are sorted along the column that varies most among them and cut near the middle, again and again. Each cut is
    at a multiple of `size`, so that all chunks but one are full.

    Args:
        rows: `(B, m)` commands.
        indices: indices of the commands to divide.
        size: the most commands in a chunk.
    """
    if len(indices) <= size:
        return [indices]
    axis = np.argmax(np.ptp(rows[indices], axis=0))
    ordered = indices[np.argsort(rows[indices, axis], kind="stable")]
    middle = -(-len(indices) // (2 * size)) * size
    return partition(rows, ordered[:middle], size) + partition(rows, ordered[middle:], size)
