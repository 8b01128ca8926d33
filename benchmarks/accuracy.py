"""Error against time: every model, order, mesh, anchor, precision and tolerance, and what to choose.

    python -m benchmarks.accuracy [--quick] [--conditions | --crease]

The reference beam with anchors of width 0.25, its top tendon pulled to ratios from 0.95 to 0.5 in steps of 0.005.
Errors of the tip angle and of the tendon's tension, in percent of the truth; the larger of the two counts. Times are of
one call after compiling, medians, each beside one jump of the reference scene (P1 29 x 7, point anchors) to the same
ratio in turn with it. It ends with the table a user chooses from: the cheapest setting for 10, 1, 0.1 and 0.01 % of
error over all ratios.

The truth is extrapolated from three meshes of six-node triangles with proportional spacing. Two errors fall at
different rates: that of the singular corner of the clamp, with the power `2 lambda` of the size of a cell, and the
rest, with about its cube. `lambda` is the exponent of a corner between a clamped and a free side (Williams, J. Appl.
Mech. 19, 1952, 526-528), in plane strain

    sin^2(lambda pi / 2) (3 - 4 nu) = 4 (1 - nu)^2 - lambda^2.

Its own error is estimated by its distance from the extrapolation from the next coarser three.

`--conditions` tells the errors elsewhere: with both tendons pulled, other proportions, Poisson's ratios, tendons and
anchors. Each is the largest over the ratios 0.95, 0.8, 0.65 and 0.5.

Below a ratio of about 0.4, and of about 0.5 on stubby beams or at a Poisson's ratio of 0.3, the surface under a tendon
creases on fine meshes, a true instability of the material: no answer there is independent of the mesh, and none is
compared. `--crease` shows it: the tension jumps as the ratio falls.
"""

from __future__ import annotations

import benchmarks.one_thread  # isort: skip # noqa: F401

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxbeam as jb
from benchmarks import report
from benchmarks.timing import in_turn

# Ratios of the top tendon: those of the table, and a few of them, at which times are taken.
FINE = np.linspace(0.95, 0.5, 91)
FEW = FINE[::30]
WIDTH = 0.25
# Cells of the meshes of the truth, along the length and across the height; the finest is `FINEST`. Elsewhere coarser
# ones are enough.
TRUTH = ((18, 12), (27, 18), (36, 24), (48, 32))
COARSER = ((12, 8), *TRUTH[:-1])
# Share of a measure by which two extrapolations differ where a mesh has creased.
CREASED = 0.005
GOALS = (10.0, 1.0, 0.1, 0.01)
FINEST = {"nx": 49, "ny": 33, "order": 2, "graded": "proportional", "diagonals": "mirrored"}
# Six-node meshes with proportional spacing, by nodes of triangles along the length and across the height.
MIRRORED = ((9, 5), (11, 5), (13, 5), (15, 7), (17, 9), (21, 9), (25, 13), (33, 17), (41, 21))
CROSSED = ((9, 4), (11, 4), (13, 5), (17, 6), (21, 7), (25, 9), (33, 12))
# Three-node crossed ones.
THREE = ((21, 5), (29, 7), (41, 11), (57, 15))
# Coarse meshes of solves on two: of three-node crossed triangles, and of six-node mirrored ones.
TWO_THREE = ((8, 4), (13, 6))
TWO_SIX = ((5, 3), (7, 5), (13, 7), (17, 9))
# Settings whose errors are told elsewhere.
ELSEWHERE = (
    "by hand",
    "rod, 9 nodes",
    "P1 29 x 7 one-sided point anchors",
    "P2 9 x 5 mirrored proportional",
    "P2 11 x 5 mirrored proportional",
    "two meshes, P2 7 x 5 mirrored proportional",
    "two meshes, P2 13 x 7 mirrored proportional",
)


class Condition(NamedTuple):
    """What is solved: arguments of `tendon_beam`, and the share of the top tendon's pull that the bottom one has."""

    name: str
    given: dict[str, Any]
    share: float = 0.0

    def commands(self, ratios: np.ndarray) -> np.ndarray:
        return np.stack([ratios, 1 - self.share * (1 - ratios)], axis=1)


REFERENCE = Condition("reference", {})
CONDITIONS = (
    REFERENCE,
    Condition("both, (r, (1 + r) / 2)", {}, 0.5),
    Condition("both, nearly alike", {}, 0.9),
    *(Condition(f"length / height {k}", {"length": 0.8 * k}) for k in (2, 3, 6, 10)),
    *(Condition(f"Poisson's ratio {nu}", {"poisson": nu}) for nu in (0.3, 0.49, 0.499)),
    Condition("tendons 5 times as stiff", {"tendon_modulus": 1e4}),
    *(Condition(f"anchors of width {width}", {"anchor_width": width}) for width in (0.125, 0.5)),
)


class Ready(NamedTuple):
    """A setting under a condition: `solve(command)`, and `measure(command, found)`: tip angle and tensions."""

    solve: Callable[[np.ndarray], Any]
    measure: Callable[[np.ndarray, Any], np.ndarray]


class Setting(NamedTuple):
    """A way to solve: `ready(given)` for the arguments of a condition."""

    name: str
    ready: Callable[[dict[str, Any]], Ready]


def beam(given: dict[str, Any], solver: jb.Newton = jb.Newton(), steps: int = 0, **mesh: Any) -> Ready:
    """A beam of triangles, solved by one jump, or by a ramp of so many steps."""
    scene = jb.tendon_beam(**({"anchor_width": WIDTH} | given | mesh))
    return Ready(partial(solved, scene, solver, steps), partial(measured, scene))


def rod(given: dict[str, Any], nodes: int) -> Ready:
    """The rod in the place of the solid, whose anchors have no width."""
    scene = jb.rod_beam(nodes, **{name: value for name, value in given.items() if name != "anchor_width"})
    return Ready(partial(solved, scene, jb.Newton(), 0), partial(measured, scene))


def two(given: dict[str, Any], **mesh: Any) -> Ready:
    """A beam of triangles, solved on two meshes."""
    meshes = jb.two_meshes(jb.tendon_beam(**({"anchor_width": WIDTH} | given | mesh)))
    told = lambda command, found: np.where(found.solution.status == 0, found.value, np.nan)
    return Ready(lambda command: jb.corrected(meshes, command, measures), told)


def measures(scene: jb.Scene, x: Any) -> jax.Array:
    """Tip angle and the tensions of both tendons `(3,)`."""
    return jnp.append(jb.tip_angle(scene, x), jb.tendon_tensions(scene, x))


def linear(given: dict[str, Any], **mesh: Any) -> Ready:
    """Linear elasticity."""
    scene = jb.tendon_beam(**({"anchor_width": WIDTH} | given | mesh))
    return Ready(lambda command: jb.linear_response(jb.command(scene, command)), partial(measured, scene))


def hand(given: dict[str, Any]) -> Ready:
    """The hand calculation."""
    given = {name: value for name, value in given.items() if name != "anchor_width"}
    told = lambda command, found: np.array([found.tip_angle, *found.tensions], float)
    return Ready(lambda command: jb.euler_bernoulli(command, **given), told)


def solved(scene: jb.Scene, solver: jb.Newton, steps: int, command: np.ndarray) -> jb.Solution:
    """By one jump, or the end of a ramp of so many steps."""
    if steps:
        return jax.tree.map(lambda leaf: leaf[-1], jb.ramp(scene, command, steps=steps, solver=solver))
    return jb.equilibrium(jb.command(scene, command), solver=solver)


def measured(scene: jb.Scene, command: np.ndarray, found: Any) -> np.ndarray:
    """Tip angle and the tensions of both tendons `(3,)`; NaN if the solution is not OK."""
    if isinstance(found, jb.Solution):
        if found.status != 0:
            return np.full(3, np.nan)
        found = found.x
    return np.asarray(measures(jb.command(scene, command), found))


def settings(quick: bool) -> list[Setting]:
    """All settings, from cheap to dear."""
    found = [
        Setting("by hand", hand),
        Setting("linear, P2 9 x 5 graded", partial(linear, nx=9, ny=5, order=2, graded=True)),
        *(Setting(f"rod, {nodes} nodes", partial(rod, nodes=nodes)) for nodes in (9, 17)),
    ]
    six, near = {"order": 2}, {"order": 2, "graded": "proportional"}
    mirrored, crossed = {"diagonals": "mirrored"}, {"diagonals": "crossed"}
    meshes: list[dict[str, Any]] = [
        {"nx": 29, "ny": 7, "anchor_width": 0.0},
        {"nx": 29, "ny": 7},
        {"nx": 57, "ny": 13},
        {"nx": 29, "ny": 7} | crossed,
        {"nx": 15, "ny": 5} | six,
        {"nx": 29, "ny": 7} | six,
        {"nx": 9, "ny": 5, "graded": True} | six,
        {"nx": 17, "ny": 6, "graded": True} | six | crossed,
        {"nx": 29, "ny": 9, "graded": True} | six,
        *({"nx": nx, "ny": ny} | near | mirrored for nx, ny in MIRRORED),
        *({"nx": nx, "ny": ny} | near | crossed for nx, ny in CROSSED),
        *({"nx": nx, "ny": ny} | near | crossed | {"order": 1} for nx, ny in THREE),
    ]
    for mesh in meshes[::3] if quick else meshes:
        found.append(Setting(label(mesh), partial(beam, **mesh)))
    for nx, ny in TWO_THREE:
        mesh = {"nx": nx, "ny": ny} | near | crossed | {"order": 1}
        found.append(Setting(f"two meshes, {label(mesh)}", partial(two, **mesh)))
    for nx, ny in TWO_SIX:
        mesh = {"nx": nx, "ny": ny} | near | mirrored
        found.append(Setting(f"two meshes, {label(mesh)}", partial(two, **mesh)))
    base = {"nx": 9, "ny": 5, "order": 2, "graded": True}
    for name, extra in (
        ("float32", {"dtype": jnp.float32}),
        ("float32, residual 1e-2", {"dtype": jnp.float32, "solver": jb.Newton(rtol=1e-2)}),
        ("residual 1e-4", {"solver": jb.Newton(rtol=1e-4)}),
        ("ramp of 10", {"steps": 10}),
    ):
        found.append(Setting(f"{label(base)}, {name}", partial(beam, **base, **extra)))
    return found


def label(mesh: dict[str, Any]) -> str:
    """The name of a mesh."""
    words = [f"P{mesh.get('order', 1)} {mesh['nx']} x {mesh['ny']}", mesh.get("diagonals", "one-sided")]
    words += [{True: "graded", "proportional": "proportional"}.get(mesh.get("graded", False), "")]
    words += ["point anchors" if mesh.get("anchor_width") == 0 else ""]
    return " ".join(word for word in words if word)


def singularity(poisson: float) -> float:
    """The exponent `lambda` of the corner of the clamp, see the head of this module."""
    excess = lambda power: np.sin(power * np.pi / 2) ** 2 * (3 - 4 * poisson) + power**2 - 4 * (1 - poisson) ** 2
    low, high = 0.5, 1.0
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) < 0 else (low, middle)
    return low


def truth(
    condition: Condition, ratios: np.ndarray, steps: int, meshes: tuple[tuple[int, int], ...] = TRUTH
) -> tuple[np.ndarray, float]:
    """Tip angle and tensions `(ratios, 3)`, NaN where the surface creases, and their own error in percent.

    Args:
        condition: what is solved.
        ratios: of the top tendon, among those of the ramp.
        steps: of a ramp from rest to the last ratio.
        meshes: four, by their cells, from coarse to fine.
    """
    rows = np.round((1 - ratios) / (1 - ratios[-1]) * (steps - 1)).astype(int)
    answers = []
    for columns, across in meshes:
        mesh = FINEST | {"nx": columns + 1, "ny": across + 1}
        scene = jb.tendon_beam(**({"anchor_width": WIDTH} | condition.given | mesh))
        path = jb.ramp(scene, condition.commands(ratios)[-1], steps=steps)
        states = (jax.tree.map(lambda leaf, row=row: leaf[row], path) for row in rows)
        answers.append([measured(scene, state.ratios, state) for state in states])
    material = jb.lame(1.0, condition.given.get("poisson", 0.45))
    # Macklin-Mueller's material has the first Lame parameter lam - mu at small strain.
    rate = 2 * singularity(float((material.lam - material.mu) / (2 * material.lam)))
    cells = np.array([columns for columns, _ in meshes], float)
    powers = np.stack([cells**0, cells**-rate, cells**-3.0], axis=1)
    other, exact = (
        np.tensordot(np.linalg.inv(powers[k : k + 3])[0], np.array(answers[k : k + 3]), axes=1) for k in (0, 1)
    )
    gap = np.abs(other / exact - 1)[:, :2].max(axis=1)
    exact[~(gap < CREASED)] = np.nan
    return exact, 100 * float(gap[gap < CREASED].max(initial=0))


def errors(ready: Ready, commands: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Percent by which tip angle and tensions are off at each command, `(ratios, 3)`; infinite for a failed solve."""
    found = np.array([ready.measure(command, ready.solve(command)) for command in commands])
    off = 100 * (found / exact - 1)
    return np.where(np.isnan(found) & ~np.isnan(exact), np.inf, off)


def worst(off: np.ndarray) -> float:
    """The largest error of the angle and of the top tendon's tension."""
    return float(np.nanmax(np.abs(off[:, :2]), initial=0))


def timed(ready: Ready, repeats: int) -> tuple[float, float]:
    """Milliseconds at 0.8, and the mean over a few ratios of the time over that of one jump of the reference scene."""
    plain, ms, over = beam({"anchor_width": 0.0}), 0.0, []
    for command in REFERENCE.commands(FEW):
        own, other = in_turn(partial(ready.solve, command), partial(plain.solve, command), repeats=repeats)
        ms = own.median * 1e3 if command[0] == FEW[1] else ms
        over.append(own.over(other))
    return ms, float(np.mean(over))


def compare(quick: bool) -> None:
    """Error and time of every setting, and the cheapest for each goal."""
    exact, own = truth(REFERENCE, FINE, 101)
    print(f"angle, tensions at {FEW}:\n{np.round(exact[::30], 5)}\nown error of the truth: {own:.4f} %\n")
    lines = []
    for setting in settings(quick):
        ready = setting.ready({})
        off = errors(ready, REFERENCE.commands(FINE), exact)
        at = FINE[np.nanargmax(np.abs(off[:, :2]).max(axis=1))]
        shown = [f"{value:+.3f}" for value in off[::30, :2].T.ravel()]
        lines.append((setting.name, *shown, worst(off), f"{at:.3f}", *timed(ready, 3 if quick else 9)))
    names = (f"{name} % at {ratio:g}" for name in ("angle", "tension") for ratio in FEW)
    report.table(("setting", *names, "worst %", "at", "ms at 0.8", "over reference"), lines)
    print("The cheapest setting for an error of angle and tension, over all ratios; the truth's own error is added:\n")
    chosen = []
    for goal in GOALS:
        fit = [(line[0], line[-4], line[-1]) for line in lines if line[-4] + own <= goal]
        chosen.append((f"{goal} %", *(min(fit, key=lambda entry: entry[2]) if fit else ("none here", None, None))))
    report.table(("error", "setting", "error %", "over reference"), chosen)


def elsewhere() -> None:
    """The largest errors over a few ratios, under every condition: of angle and of the tension of the top tendon."""
    chosen = [s for s in settings(False) if s.name in ELSEWHERE]
    lines = []
    for condition in CONDITIONS:
        exact, own = truth(condition, FEW, 11, COARSER)
        kept, line = int((~np.isnan(exact[:, 0])).sum()), []
        for setting in chosen:
            off = errors(setting.ready(condition.given), condition.commands(FEW), exact)[:kept]
            line.append("/".join(f"{value:.2f}" for value in np.abs(off[:, :2]).max(axis=0)))
        lines.append((condition.name, f"{FEW[kept - 1]:g}", *line, own))
    report.table(("largest error of angle/tension, %", "down to", *(s.name for s in chosen), "of the truth"), lines)


def crease() -> None:
    """Tension of the top tendon as its ratio falls, on a coarse and on a fine mesh."""
    ratios = np.linspace(1, 0.36, 65)
    rows = []
    for mesh in ({"nx": 29, "ny": 7}, {"nx": 113, "ny": 25, "order": 2}):
        scene = jb.tendon_beam(anchor_width=WIDTH, **mesh)
        path = jb.ramp(scene, [ratios[-1], 1.0], steps=len(ratios))
        tensions = jax.vmap(lambda r, x, scene=scene: jb.tendon_tensions(jb.command(scene, r), x)[0])
        values = np.asarray(tensions(path.ratios, path.x))
        k = int(np.argmax(np.abs(np.diff(values, 2)))) + 1
        failed = int((np.asarray(path.status) != 0).sum())
        rows.append((label(mesh), float(ratios[k]), float(np.diff(values)[k]), failed))
    report.table(("mesh", "sharpest bend at ratio", "change of tension there", "steps not OK"), rows)


def main() -> None:
    parser = report.options(__doc__)
    parser.add_argument("--quick", action="store_true", help="every third mesh, and fewer repeats")
    parser.add_argument("--conditions", action="store_true", help="only the errors elsewhere")
    parser.add_argument("--crease", action="store_true", help="only show the crease on fine meshes")
    options = parser.parse_args()
    report.head("Error against time")
    if options.crease:
        crease()
    elif options.conditions:
        elsewhere()
    else:
        compare(options.quick)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
