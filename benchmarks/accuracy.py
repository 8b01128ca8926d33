"""Error against time: every model, order, mesh, anchor, precision and tolerance, and what to choose.

    python -m benchmarks.accuracy [--quick] [--poisson 0.45 ...] [--crease]

The reference beam with anchors of width 0.25, its top tendon pulled to ratios from 0.95 to 0.5, at Poisson's ratios
from 0.3 to 0.4999. Errors of the tip angle and of the tendon's tension, in percent of a solution on a graded mesh of
crossed six-node triangles (57 x 13 corners), whose own error is estimated from one of half the fineness. The larger of
the two counts. Times are of one call after compiling, medians, each beside one jump of the reference scene (P1 29 x 7,
point anchors, Poisson's ratio 0.45) to the same ratio in turn with it; at 0.4999 settings are ramped to the command,
which a jump reaches in a hundred steps.

For each Poisson's ratio it ends with the table a user chooses from: the cheapest setting for 10, 1, 0.1 and 0.01 % of
error over all ratios.

Below a ratio of about 0.4, and of about 0.5 at a Poisson's ratio of 0.3, the surface under a tendon creases on fine
meshes, a true instability of the material: no answer there is independent of the mesh, and none is compared. `--crease`
shows it: the tension jumps as the ratio falls.
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

RATIOS = (0.95, 0.8, 0.6, 0.5)
POISSONS = (0.3, 0.45, 0.49, 0.499, 0.4999)
WIDTH = 0.25
FINEST = {"nx": 57, "ny": 13, "order": 2, "graded": True, "diagonals": "crossed"}
HALF = FINEST | {"nx": 29, "ny": 7}
# Share of it by which a measure differs between two fine meshes where one has creased and the other not.
CREASED = 0.05
GOALS = (10.0, 1.0, 0.1, 0.01)


class Setting(NamedTuple):
    """A way to solve: `scene(poisson)` at rest and `solve(scene, ratios) -> x`."""

    name: str
    scene: Callable[[float], jb.Scene]
    solve: Callable[[jb.Scene, list[float]], Any]


def beam(poisson: float, **kwargs: Any) -> jb.Scene:
    """The reference beam with wide anchors, unless said otherwise."""
    return jb.tendon_beam(poisson=poisson, **({"anchor_width": WIDTH} | kwargs))


def solved(scene: jb.Scene, ratios: list[float], solver: jb.Newton = jb.Newton(), steps: int = 0) -> jb.Solution:
    """By one jump, or by a ramp of so many steps."""
    if steps:
        return jax.tree.map(lambda leaf: leaf[-1], jb.ramp(scene, ratios, steps=steps, solver=solver))
    return jb.equilibrium(jb.command(scene, ratios), solver=solver)


def settings(quick: bool) -> list[Setting]:
    """All settings, from cheap to dear."""
    found = [Setting("linear, P2 9 x 5 graded", partial(beam, nx=9, ny=5, order=2, graded=True), linear)]
    for nodes in (9, 17):
        found.append(Setting(f"rod, {nodes} nodes", partial(rod, nodes=nodes), solved))
    meshes: list[dict[str, Any]] = [
        {"nx": 15, "ny": 4},
        {"nx": 29, "ny": 7, "anchor_width": 0.0},
        {"nx": 29, "ny": 7},
        {"nx": 57, "ny": 13},
        {"nx": 15, "ny": 5, "diagonals": "crossed"},
        {"nx": 29, "ny": 7, "diagonals": "crossed"},
        {"nx": 29, "ny": 7, "diagonals": "mirrored"},
        {"nx": 29, "ny": 7, "graded": True},
        {"nx": 7, "ny": 3, "order": 2},
        {"nx": 15, "ny": 5, "order": 2},
        {"nx": 29, "ny": 7, "order": 2},
        {"nx": 7, "ny": 3, "order": 2, "graded": True},
        {"nx": 9, "ny": 4, "order": 2, "graded": True},
        {"nx": 9, "ny": 5, "order": 2, "graded": True},
        {"nx": 11, "ny": 5, "order": 2, "graded": True},
        {"nx": 15, "ny": 5, "order": 2, "graded": True},
        {"nx": 15, "ny": 5, "order": 2, "graded": True, "degree": 4},
        {"nx": 21, "ny": 7, "order": 2, "graded": True},
        {"nx": 29, "ny": 9, "order": 2, "graded": True},
        {"nx": 9, "ny": 4, "order": 2, "graded": True, "diagonals": "crossed"},
        {"nx": 15, "ny": 5, "order": 2, "graded": True, "diagonals": "crossed"},
        {"nx": 17, "ny": 6, "order": 2, "graded": True, "diagonals": "crossed"},
        HALF,
    ]
    for mesh in meshes[::3] if quick else meshes:
        found.append(Setting(label(mesh), partial(beam, **mesh), solved))
    base = {"nx": 9, "ny": 5, "order": 2, "graded": True}
    for name, extra, solve in (
        ("float32", {"dtype": jnp.float32}, solved),
        ("float32, residual 1e-3", {"dtype": jnp.float32}, partial(solved, solver=jb.Newton(rtol=1e-3))),
        ("float32, residual 1e-2", {"dtype": jnp.float32}, partial(solved, solver=jb.Newton(rtol=1e-2))),
        ("residual 1e-3", {}, partial(solved, solver=jb.Newton(rtol=1e-3))),
        ("residual 1e-4", {}, partial(solved, solver=jb.Newton(rtol=1e-4))),
        ("residual 1e-7", {}, partial(solved, solver=jb.Newton(rtol=1e-7))),
        ("ramp of 4", {}, partial(solved, steps=4)),
        ("ramp of 10", {}, partial(solved, steps=10)),
    ):
        found.append(Setting(f"{label(base)}, {name}", partial(beam, **base, **extra), solve))
    return found


def label(mesh: dict[str, Any]) -> str:
    """The name of a mesh."""
    words = [f"P{mesh.get('order', 1)} {mesh['nx']} x {mesh['ny']}", mesh.get("diagonals", "")]
    words += ["graded" if mesh.get("graded") else "", f"degree {mesh['degree']}" if "degree" in mesh else ""]
    words += ["point anchors" if mesh.get("anchor_width") == 0 else ""]
    return " ".join(word for word in words if word)


def rod(poisson: float, nodes: int) -> jb.Scene:
    """The rod in the place of the solid."""
    return jb.rod_beam(nodes, poisson=poisson)


def linear(scene: jb.Scene, ratios: list[float]) -> Any:
    """The answer of linear elasticity."""
    return jb.linear_response(jb.command(scene, ratios))


def measured(scene: jb.Scene, ratios: list[float], x: Any) -> np.ndarray:
    """Tip angle, and the tension and length of the top tendon."""
    scene = jb.command(scene, ratios)
    tension, length = jb.tendon_tensions(scene, x)[0], jb.tendon_lengths(scene, x)[0]
    return np.array([jb.tip_angle(scene, x), tension, length], float)


def references(poisson: float) -> tuple[np.ndarray, np.ndarray]:
    """Measures `(ratios, 3)` on the finest mesh, and their distance from those on one half as fine; NaN where these are
    so far apart that there is no answer to tell an error from: one mesh has creased."""
    answers = []
    for mesh in (FINEST, HALF):
        scene, rows = beam(poisson, **mesh), []
        for ratio in RATIOS:
            found = jb.check(solved(scene, [ratio, 1.0], steps=9))
            rows.append(measured(scene, [ratio, 1.0], found.x))
        answers.append(np.array(rows))
    truth, gap = answers[0], answers[0] - answers[1]
    creased = np.any(np.abs(gap) > CREASED * np.abs(truth), axis=1, keepdims=True)
    return np.where(creased, np.nan, truth), np.where(creased, np.nan, gap)


def timed(run: Callable[[], Any], ratio: float, repeats: int) -> dict[str, float]:
    """Milliseconds of a solve, and those over the time that one jump of the reference scene takes in turn with it."""
    own, other = in_turn(run, partial(solved, jb.tendon_beam(), [ratio, 1.0]), repeats=repeats)
    return {"ms": 1e3 * own.median, "over": own.over(other)}


def errors(setting: Setting, poisson: float, truth: np.ndarray, repeats: int) -> list[dict[str, Any]]:
    """Percent of error and time of a setting at every ratio."""
    scene, rows = setting.scene(poisson), []
    steep = poisson > 0.495
    solve = partial(solved, steps=9) if setting.solve is solved and steep else setting.solve
    for ratio, exact in zip(RATIOS, truth, strict=True):
        command = [ratio, 1.0]
        found = solve(scene, command)
        x, status = (found.x, int(found.status)) if isinstance(found, jb.Solution) else (found, 0)
        off = 100 * (measured(scene, command, x) / exact - 1)
        row = {"setting": setting.name, "poisson": poisson, "ratio": ratio, "status": status}
        row |= timed(partial(solve, scene, command), ratio, repeats)
        rows.append(row | {"angle": off[0], "tension": off[1], "length": off[2]})
    return rows


def hand(poisson: float, truth: np.ndarray, repeats: int) -> list[dict[str, Any]]:
    """The hand calculation."""
    rows = []
    for ratio, exact in zip(RATIOS, truth, strict=True):
        calculate = partial(jb.euler_bernoulli, [ratio, 1.0], poisson=poisson)
        found = calculate()
        off = 100 * (np.array([found.tip_angle, found.tensions[0], found.lengths[0]]) / exact - 1)
        row = {"setting": "by hand", "poisson": poisson, "ratio": ratio, "status": 0} | timed(calculate, ratio, repeats)
        rows.append(row | {"angle": off[0], "tension": off[1], "length": off[2]})
    return rows


def print_rows(rows: list[dict[str, Any]], poisson: float) -> None:
    """Errors of the angle and tension at each ratio, a line for each setting."""
    percents = (f"{ratio} {measure} %" for measure in ("angle", "tension") for ratio in RATIOS)
    header = (f"nu = {poisson}", *percents, "ms at 0.8", "over reference")
    names = list(dict.fromkeys(row["setting"] for row in rows))
    lines = []
    for name in names:
        own = [row for row in rows if row["setting"] == name]
        show = lambda value, row: "-" if row["status"] or np.isnan(value) else f"{value:+.3f}"
        angles, tensions = ([show(row[key], row) for row in own] for key in ("angle", "tension"))
        times = own[RATIOS.index(0.8)]["ms"], float(np.mean([row["over"] for row in own]))
        lines.append((name, *angles, *tensions, *times))
    report.table(header, lines)


def worst(rows: list[dict[str, Any]]) -> list[tuple[str, float, float]]:
    """Of each setting: over all ratios its largest error, of angle or tension, and its mean time."""
    found = []
    for name in dict.fromkeys(row["setting"] for row in rows):
        own = [row for row in rows if row["setting"] == name]
        if not any(row["status"] for row in own):
            error = float(np.nanmax([[abs(row["angle"]), abs(row["tension"])] for row in own]))
            found.append((name, error, float(np.mean([row["over"] for row in own]))))
    return found


def choose(rows: list[dict[str, Any]], floor: float) -> list[tuple[Any, ...]]:
    """The cheapest setting for each goal; the reference's own error is added to each."""
    lines = []
    for goal in GOALS:
        fit = [entry for entry in worst(rows) if entry[1] + floor <= goal]
        lines.append((f"{goal} %", *(min(fit, key=lambda entry: entry[2]) if fit else ("none here", None, None))))
    return lines


def crease() -> None:
    """Tension of the top tendon as its ratio falls, on a coarse and on a fine mesh."""
    ratios = np.linspace(1, 0.36, 65)
    rows = []
    for mesh in ({"nx": 29, "ny": 7}, {"nx": 113, "ny": 25, "order": 2}):
        path = jb.ramp(beam(0.45, **mesh), [ratios[-1], 1.0], steps=len(ratios))
        tensions = jax.vmap(lambda r, x, mesh=mesh: jb.tendon_tensions(jb.command(beam(0.45, **mesh), r), x)[0])
        values = np.asarray(tensions(path.ratios, path.x))
        k = int(np.argmax(np.abs(np.diff(values, 2)))) + 1
        rows.append(
            (label(mesh), float(ratios[k]), float(np.diff(values)[k]), int((np.asarray(path.status) != 0).sum()))
        )
    report.table(("mesh", "sharpest bend at ratio", "change of tension there", "steps not OK"), rows)


def main() -> None:
    parser = report.options(__doc__)
    parser.add_argument("--quick", action="store_true", help="every third mesh, and fewer repeats")
    parser.add_argument("--poisson", type=float, nargs="+", default=POISSONS, help="Poisson's ratios")
    parser.add_argument("--crease", action="store_true", help="only show the crease on fine meshes")
    options = parser.parse_args()
    report.head("Error against time")
    if options.crease:
        crease()
        return
    for poisson in options.poisson:
        truth, gap = references(poisson)
        floor = float(np.nanmax(np.abs(100 * gap / truth)[:, :2]) / 3)
        print(f"nu = {poisson}: angle, tension, length at {RATIOS}:\n{np.round(truth, 5)}")
        print(f"error of this reference, a third of its distance from half the fineness: {floor:.4f} %\n")
        repeats = 3 if options.quick else 7
        rows = hand(poisson, truth, repeats)
        for setting in settings(options.quick):
            rows += errors(setting, poisson, truth, repeats)
        print_rows(rows, poisson)
        print("The cheapest setting for an error of angle and tension, over all ratios:\n")
        report.table(("error", "setting", "error %", "over reference"), choose(rows, floor))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
