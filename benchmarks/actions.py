"""What acts on a body: what it costs, and whether error bars hold under it.

    python -m benchmarks.actions [--repeats 9] [--quick]

1. Time of a Newton step with 1 to 64 cables on 57 x 13 nodes: from the clamp to a place on a side, and through seven
   guides at random, both ends free.
2. Time of a Newton step with contact on 200 nodes of the surface over that without, on three meshes. The obstacle is
   not touched, so the steps are the same.
3. Error bars of scenes under each kind of action at three strengths, on four meshes. The truth is a mesh of six-node
   triangles on 65 x 13 corners, corrected by its own estimate. How often the true error is within the bar.
"""

from __future__ import annotations

import benchmarks.one_thread  # isort: skip # noqa: F401

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

import jaxbeam as jb
from benchmarks import report
from benchmarks.timing import in_turn
from jaxbeam.solve.newton import topology

COUNTS = (1, 2, 4, 8, 16, 32, 64)
STEPS = 6


# ------------------------------------------------------------------------------------------------- costs


def lines_of(count: int, kind: str, nx: int, ny: int) -> np.ndarray:
    """Nodes `(count, k)` of cables along the sides of a beam of `nx` x `ny` nodes."""
    rng, rows = np.random.default_rng(0), []
    for k in range(count):
        side = np.arange(nx) * ny + (ny - 1 if k % 2 == 0 else 0)
        if kind == "from the clamp":
            end = int(np.linspace(8, nx - 1, max(2, (count + 1) // 2))[k // 2])
            rows.append(side[[0, end // 2, end]])
        else:
            rows.append(side[np.sort(rng.choice(np.arange(1, nx), 9, replace=False))])
    return np.stack(rows)


def cables(repeats: int) -> None:
    """Print the time of a step with more and more cables."""
    beam = jb.tendon_beam(57, 13)
    for kind in ("from the clamp", "through guides"):
        runs: list[Callable[[], Any]] = []
        shapes, steps = [], []
        for count in COUNTS:
            term = jb.cables(beam.mesh, lines_of(count, kind, 57, 13), 2e3 / count, transition=0.05)
            scene = jb.Scene(beam.mesh, (beam.terms[0], term), beam.fixed, beam.tip)
            run = partial(jb.ramp, scene, np.where(np.arange(count) % 2 == 0, 0.9, 1.0), STEPS)
            runs.append(run)
            steps.append(int(jb.check(run()).steps.sum()))
            shapes.append(jb.Newton().linear.layout(topology(scene)).blocks)
        times = in_turn(*runs, repeats=repeats)
        each = [timing.median / count for timing, count in zip(times, steps, strict=True)]
        rows = [
            (str(count), n, shape[-1], 1e3 * t, t / each[3])
            for count, n, shape, t in zip(COUNTS, steps, shapes, each, strict=True)
        ]
        print(kind)
        report.table(("cables", "steps", "border", "ms a step", "over 8 cables"), rows)


def contact(repeats: int) -> None:
    """Print what contact adds to a step."""
    rows = []
    for nx, ny in ((101, 9), (101, 17), (201, 9)):
        beam = jb.tendon_beam(nx, ny)
        touching = jb.nodes_where(beam.mesh, lambda x, y: (y == y.min()) | ((y == y.max()) & (len(y) < 1800)))
        floor = jb.contact(beam.mesh, touching, jb.half_plane([0.0, -9.0], [0.0, 1.0]), 1e4, 0.01)
        near = jb.Scene(beam.mesh, (*beam.terms, floor), beam.fixed, beam.tip)
        runs = (partial(jb.ramp, beam, [1.0, 0.85], STEPS), partial(jb.ramp, near, [1.0, 0.85, 0.0], STEPS))
        same = [int(jb.check(run()).steps.sum()) for run in runs]
        assert same[0] == same[1], same
        without, with_ = in_turn(*runs, repeats=repeats)
        rows.append((f"{nx} x {ny}", len(touching), 1e3 * without.median / same[0], with_.over(without)))
    report.table(("mesh", "nodes", "ms a step", "with contact over it"), rows)


# -------------------------------------------------------------------------------------------- error bars


class Act(NamedTuple):
    """A kind of action: the term on a mesh, its strengths, which ends are clamped, and a measure."""

    term: Callable[[jb.Mesh, float], tuple[jb.Term, list[float]]]
    strengths: tuple[float, float, float]
    both_ends: bool = False
    measure: Callable[[jb.Scene, jax.Array], jax.Array] = jb.tip_angle


def side(mesh: jb.Mesh, top: bool) -> np.ndarray:
    return jb.nodes_where(mesh, lambda x, y: y == (y.max() if top else y.min()))


def end(mesh: jb.Mesh) -> np.ndarray:
    return jb.nodes_where(mesh, lambda x, y: x == x.max())


def line(mesh: jb.Mesh) -> list[int]:
    """A line along the top: the clamp, a guide, and an end past the middle."""
    return [jb.nearest_node(mesh, [x, 0.4]) for x in (-1.75, -0.875, 0.875)]


def middle(scene: jb.Scene, x: jax.Array) -> jax.Array:
    """Height of the tip, here the middle of the upper side."""
    return jb.tip_position(scene, x)[1]


def push(scene: jb.Scene, x: jax.Array) -> jax.Array:
    """Force of the support in y."""
    return jb.reactions(scene, x)[scene.tip, 1].sum()


def touch(scene: jb.Scene, x: jax.Array) -> jax.Array:
    """Force of the obstacle in y."""
    return jb.contact_forces(scene, x)[:, 1].sum()


WIDTHS = [[0.0, 0.25, 0.25]]
DISK = jb.disk([1.2, -0.9], 0.45)
ACTS = {
    "cable": Act(lambda m, v: (jb.cables(m, [line(m)], 2e3, width=WIDTHS), [v]), (0.95, 0.85, 0.7)),
    "pull": Act(lambda m, v: (jb.pulls(m, [line(m)], width=WIDTHS), [v]), (20.0, 100.0, 300.0)),
    "weight": Act(lambda m, v: (jb.weight(m, [0.0, -v]), []), (1.0, 10.0, 40.0)),
    "traction": Act(lambda m, v: (jb.traction(m, side(m, True), [0.0, -v]), []), (1.0, 10.0, 40.0)),
    "pressure": Act(lambda m, v: (jb.pressure(m, side(m, True)), [v]), (50.0, 200.0, 600.0), True, middle),
    "contact": Act(lambda m, v: (jb.contact(m, side(m, False), DISK, 1e4, 0.01), [v]), (0.1, 0.3, 0.6)),
    "contact force": Act(
        lambda m, v: (jb.contact(m, side(m, False), DISK, 1e4, 0.01), [v]), (0.1, 0.3, 0.6), False, touch
    ),
    "support": Act(lambda m, v: (jb.support(m, end(m), y=1.0), [v]), (0.05, 0.3, 1.0), False, push),
    "tip load": Act(
        lambda m, v: (jb.dead_load(m, [jb.nearest_node(m, [1.75, 0.0])], [0.0, -v]), []), (5.0, 20.0, 60.0)
    ),
}
MESHES = {"P1 17 x 5": (17, 5, 1), "P1 33 x 9": (33, 9, 1), "P2 9 x 3": (9, 3, 2), "P2 17 x 5": (17, 5, 2)}
FINE = (65, 13, 2)


def solved(act: Act, strength: float, nx: int, ny: int, order: int) -> jb.ErrorEstimate:
    """The measure and its error bar on one mesh."""
    mesh = jb.rectangle(3.5, 0.8, nx, ny, order=order)
    term, commands = act.term(mesh, strength)
    left = jb.nodes_where(mesh, lambda x, y: x == x.min())
    held = np.concatenate([left, end(mesh)]) if act.both_ends else left
    tip = [jb.nearest_node(mesh, [0.0, 0.4])] if act.both_ends else end(mesh)
    scene = jb.Scene(mesh, (jb.solid(mesh, jb.lame(1e4, 0.45)), term), jb.clamped(mesh, held), tip)
    scene = jb.command(scene, commands)
    return jb.estimate_error(scene, jb.equilibrium(scene), act.measure)


def bars(quick: bool) -> None:
    """Print how often the bars hold under each kind of action."""
    rows, held, all_of = [], 0, 0
    for name, act in ACTS.items():
        good = count = infinite = 0
        ratios = []
        for strength in act.strengths[1:2] if quick else act.strengths:
            exact = solved(act, strength, *FINE)
            truth, slack = exact.value + exact.discretisation, 2 * abs(exact.discretisation)
            for mesh, settings in MESHES.items():
                found = solved(act, strength, *settings)
                true = truth - found.value
                count += 1
                good += abs(true) <= found.bar + slack
                infinite += np.isinf(found.bar)
                ratios.append(found.bar / max(abs(true), 1e-300))
                if not abs(true) <= found.bar + slack:
                    print(f"  {name} {strength} on {mesh}: off by {true:.3g} of {truth:.4g}, bar {found.bar:.3g}")
        rows.append((name, count, 100 * good / count, infinite, float(np.median(ratios))))
        held, all_of = held + good, all_of + count
    report.table(("action", "bars", "hold %", "infinite", "median bar / error"), rows)
    print(f"{100 * held / all_of:.1f} % of {all_of} bars hold")


def main() -> None:
    """Print the tables."""
    parser = report.options(__doc__)
    parser.add_argument("--repeats", type=int, default=9, help="timed calls of each")
    parser.add_argument("--quick", action="store_true", help="one strength of each kind")
    options = parser.parse_args()
    report.head("What acts on a body")
    cables(options.repeats)
    contact(options.repeats)
    bars(options.quick)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
