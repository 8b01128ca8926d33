"""How do I fit the model to measurements, and how far can I trust it then?

By `fit`: least squares of all that was measured, with an error for each parameter that the data determine. A rubber
beam was bent by two contractile tendons, while a camera saw four markers and load cells the tensions. Unknown are the
moduli of the rubber, the stiffness of the tendons, and the natural length of the upper one.

Positions alone do not tell what a force is: Young's modulus and the stiffness follow only as a ratio. Tensions, or a
data sheet, add the scale. Bad readings are named and left out. Then `predict` tells the tip angle under commands that
were not tried, and `next_experiment` which one is best tried next. A rod fitted to the same data shows what a wrong
model looks like: its errors are small, but its chi-square is far above 1, its residuals have a pattern, and its
predictions miss the truth by many of their errors.

The measurements are made up. `--make` writes them, by a finer mesh, with noise, two gross mistakes and a marker that
was hidden once. It also writes true tip angles, to judge the predictions. Lengths are in mm, forces in N.
"""

import argparse
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import jaxbeam as jb
from jaxbeam import plot

jax.config.update("jax_enable_x64", True)

Theta = dict[str, Any]

DATA = Path(__file__).with_name("15_measurements.csv")
TRUE_ANGLES = Path(__file__).with_name("15_true_angles.csv")
LENGTH, HEIGHT, WIDTH = 140.0, 32.0, 100.0  # the body of the model has unit width, so its modulus is that of all of it
# Tendons pull on plates of width 16.
MESH: dict[str, Any] = {"order": 2, "graded": "proportional", "diagonals": "mirrored", "anchor_width": 16.0}
POINTS = np.array([[0.0, 12.0], [0.0, -12.0], [70.0, 12.0], [70.0, -12.0]])  # markers at rest, from the beam's middle
NODES = np.array([8, 8, 16, 16])  # of the rod, at whose sections they lie
COLUMNS = [f"marker {k} {axis}" for k in (1, 2, 3, 4) for axis in "xy"] + ["upper tension", "lower tension"]
SD = np.array(8 * [0.14] + 2 * [0.4])  # a thousandth of the length, and that of the load cells
SHEET, SHEET_SD = 250.0, 25.0  # stiffness of the tendons by their data sheet
START = {"young": 0.3, "poisson": 0.4, "stiffness": 150.0, "upper length": 70.0}
LOW = {"young": 0.01, "poisson": 0.0, "stiffness": 1.0, "upper length": 50.0}
HIGH = {"young": 10.0, "poisson": 0.495, "stiffness": 1e4, "upper length": 90.0}
UNITS = {"young": "MPa", "poisson": "", "stiffness": "N", "upper length": "mm"}
NEW = np.stack([np.linspace(1.0, 0.5, 11), np.full(11, 0.95)], axis=1)  # measured was down to 0.6, not beside 0.95
CANDIDATES = np.stack(np.meshgrid(*2 * [np.linspace(0.6, 1.0, 9)]), axis=-1).reshape(-1, 2)
UPPER, LOWER, GREEN = plot.PALETTE[:3]
CROSS: dict[str, Any] = {"marker": "x", "ms": 6, "mew": 1.6, "color": plot.PALETTE[3], "ls": ""}
LEGEND: dict[str, Any] = {"frameon": False, "fontsize": "small", "handletextpad": 0.5}
# What the made-up measurements hide.
TRUTH = {"young": 0.42, "poisson": 0.46, "stiffness": 240.0, "upper length": 71.3}
MISTAKES, HIDDEN = {(11, 3): 6.0, (21, 8): -8.0}, (17, [4, 5])  # observation, column or columns


# ---------------------------------------------------------------------------------------------------- models


def beam(theta: Theta, nx: int = 17, ny: int = 7) -> jb.Scene:
    """The beam of six-node triangles."""
    return with_upper_length(jb.tendon_beam(nx, ny, LENGTH, HEIGHT, **material(theta), **MESH), theta)


def rod(theta: Theta) -> jb.Scene:
    """The beam as a rod."""
    return with_upper_length(jb.rod_beam(17, LENGTH, HEIGHT, **material(theta)), theta)


def material(theta: Theta) -> dict[str, Any]:
    """What both models are made of."""
    numbers = {"young": theta["young"] * WIDTH, "poisson": theta["poisson"], "tendon_modulus": theta["stiffness"]}
    return numbers | {"density": jb.neo_hookean, "stiffness": jb.inverse_stiffness}


def with_upper_length(scene: jb.Scene, theta: Theta) -> jb.Scene:
    """The scene with a natural length of its upper tendon that is not the distance of its ends."""
    body, pair = scene.terms
    natural = jnp.asarray(pair.params.natural).at[0].set(theta["upper length"])
    params = dataclasses.replace(pair.params, natural=natural, commanded=natural)
    return jb.Scene(scene.mesh, (body, jb.Term(pair.energy, pair.nodes, params)), scene.fixed, scene.tip)


def measures_of(scene: jb.Scene) -> Callable[[jb.Scene, jax.Array], jax.Array]:
    """What camera and load cells measure on this mesh, as a function `(scene, x)` to `(10,)`."""
    markers = jb.marker(scene, POINTS)
    return lambda scene, x: jnp.concatenate([markers(scene, x).ravel(), jb.tendon_tensions(scene, x)])


def measures_of_rod(scene: jb.Scene, x: jax.Array) -> jax.Array:
    """The same of the rod: a marker lies on the section of a node, beside the axis."""
    angle, beside = x[NODES, 2] / scene.mesh.radian, POINTS[:, 1:]
    markers = x[NODES, :2] + beside * jnp.stack([-jnp.sin(angle), jnp.cos(angle)], axis=1)
    return jnp.concatenate([markers.ravel(), jb.tendon_tensions(scene, x)])


# ---------------------------------------------------------------------------------------------- measurements


def make(data: Path = DATA, angles: Path = TRUE_ANGLES) -> None:
    """Write measurements, and the true tip angles under the commands `NEW`."""
    scene = beam(TRUTH, 25, 9)
    lower = np.linspace(1.0, 0.66, 5)
    rows = np.array([[r, s] for k, r in enumerate(np.linspace(1.0, 0.6, 6)) for s in lower[:: (-1) ** k]])
    found = jb.check(jb.sweep(scene, np.concatenate([rows, NEW])))
    measured, angle = (
        np.asarray(jax.vmap(lambda r, x, measure=measure: measure(jb.command(scene, r), x))(found.ratios, found.x))
        for measure in (measures_of(scene), jb.tip_angle)
    )
    noisy = measured[: len(rows)] + SD * np.random.default_rng(0).standard_normal((len(rows), len(SD)))
    for place, mistake in MISTAKES.items():
        noisy[place] += mistake
    noisy[HIDDEN] = np.nan
    words = f"A beam of {LENGTH:g} x {HEIGHT:g} x {WIDTH:g} mm under two tendons of stiffness EA"
    head = [words, "ratios of commanded to natural length (1), positions of markers (mm), tensions (N)"]
    head.append("upper ratio, lower ratio, " + ", ".join(COLUMNS))
    np.savetxt(data, np.hstack([rows, noisy]), ["%.3f"] * 2 + ["%.2f"] * 10, ", ", header="\n".join(head))
    table = np.column_stack([NEW, angle[len(rows) :]])
    head = [words, "ratios (1), tip angle (degrees)", "upper ratio, lower ratio, tip angle"]
    np.savetxt(angles, table, ["%.3f"] * 2 + ["%.5f"], ", ", header="\n".join(head))


def read() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Commands `(N, 2)`, values `(N, 10)` and their standard deviations, infinite for values that are missing."""
    table = np.loadtxt(DATA, delimiter=",")
    rows, values = table[:, :2], table[:, 2:]
    missing = np.isnan(values)
    return rows, np.where(missing, 0.0, values), np.where(missing, np.inf, SD)


# ----------------------------------------------------------------------------------------------------- fits


def without_outliers(
    fitted: jb.Fit, again: Callable[[Theta, np.ndarray], jb.Fit], sd: np.ndarray
) -> tuple[jb.Fit, np.ndarray, list[tuple[int, int]]]:
    """The fit without its outliers, the standard deviations it was made with, and the places that were left out.

    The largest goes first, and the others are judged again: a gross mistake bends the fit, and makes others look bad.
    """
    sd, left_out = sd.copy(), []
    while len(fitted.outliers):
        k, j = fitted.outliers[0].tolist()
        left_out.append((k, j))
        sd[k, j] = np.inf
        fitted = again(fitted.theta, sd)
    return fitted, sd, left_out


def told(fitted: jb.Fit, name: str) -> str:
    """What a fit tells of a parameter, in a few words."""
    value, error = float(fitted.theta[name]), float(fitted.errors[name])
    if np.isfinite(error):
        return f"{value:.5g} +- {error:.2g}"
    return f"{value:.5g}, at its bound" if fitted.held[fitted.names.index(name)] else "not determined"


def show(fits: dict[str, jb.Fit]) -> None:
    """A table of parameters, and how good each fit is."""
    print("\n" + " " * 19 + f"{'truth':10}" + "".join(f"{name:21}" for name in fits))
    for name, true in TRUTH.items():
        label = f"{name} ({UNITS[name]})" if UNITS[name] else name
        print(f"{label:19}{true:<10g}" + "".join(f"{told(fitted, name):21}" for fitted in fits.values()))
    print(f"{'chi-square / dof':29}" + "".join(f"{fitted.reduced_chi_square:<21.2f}" for fitted in fits.values()))
    print(f"{'like its neighbour':29}" + "".join(f"{alike(fitted):<21.2f}" for fitted in fits.values()))


def alike(fitted: jb.Fit) -> float:
    """Correlation of the residuals of neighbouring observations: near 0 if they are noise."""
    r = fitted.residuals
    return float(np.sum(r[1:] * r[:-1]) / np.sum(r**2))


# ------------------------------------------------------------------------------------------------- pictures


def draw_camera(ax: Axes, fitted: jb.Fit, rows: np.ndarray, values: np.ndarray, used: np.ndarray) -> None:
    """Markers where the camera saw them and where the fit has them, with the beam at the command that bends it most."""
    bent = int(np.argmax(fitted.values[:, 7]))
    seen, fits = values[:, :8].reshape(-1, 2), fitted.values[:, :8].reshape(-1, 2)
    bounds = plot.limits(fits, fitted.x[bent], [[-0.5 * LENGTH, -0.5 * HEIGHT]], margin=0.06)
    plot.Picture(jb.command(beam(fitted.theta), rows[bent]), fitted.x[bent], ax=ax, bounds=bounds)
    good, hidden = used[:, :8].reshape(-1, 2).all(axis=1), (seen == 0).all(axis=1)
    ax.plot(*seen[good].T, "o", ms=3.6, mfc="white", mec="0.3", mew=0.6, zorder=8, label="measured")
    ax.plot(*fits[good].T, ".", ms=2.4, color="black", zorder=9, label="fit")
    ax.plot(*seen[~good & ~hidden].T, **CROSS, zorder=10, label="left out")
    ax.set(xlabel="x (mm)", ylabel="y (mm)")
    ax.legend(handles=ax.lines[-3:], loc="lower left", **LEGEND)


def draw_tensions(ax: Axes, fitted: jb.Fit, values: np.ndarray, used: np.ndarray) -> None:
    """Tensions by observation."""
    for j, colour, name in ((8, UPPER, "upper"), (9, LOWER, "lower")):
        good = used[:, j]
        ax.plot(fitted.values[:, j], color=colour, lw=0.9)
        ax.plot(np.flatnonzero(good), values[good, j], "o", ms=3.2, mfc="white", mec=colour, mew=0.8, label=name)
        ax.plot(np.flatnonzero(~good), values[~good, j], **CROSS)
    ax.set(ylabel="tension (N)")
    ax.legend(loc="upper left", **LEGEND)


def draw_residuals(ax: Axes, fitted: jb.Fit, values: np.ndarray, used: np.ndarray, most: float) -> None:
    """Residuals by observation. Those of values that were left out lie outside, with their size in figures."""
    kinds = (("x", slice(0, 8, 2), "o"), ("y", slice(1, 8, 2), "s"), ("tension", slice(8, 10), "^"))
    ax.axhspan(-1.96, 1.96, color="0.92", zorder=0)
    ax.axhline(0, color="0.6", lw=0.6, zorder=1)
    for (name, columns, marker), colour in zip(kinds, ("0.45", LOWER, GREEN), strict=True):
        at, _ = places = np.nonzero(used[:, columns])
        r = fitted.residuals[:, columns][places]
        ax.plot(at, r, marker, ms=2.8, mfc="none", mew=0.7, color=colour, label=name)
    off = (fitted.values - values) / SD
    for k, j in np.argwhere(~used & (values != 0)).tolist():
        edge = 0.86 * most * np.sign(off[k, j])
        ax.plot(k, edge, **CROSS)
        ax.annotate(f"{off[k, j]:+.0f}", (k, edge), (6, -3), textcoords="offset points", fontsize="small")
    ax.set(ylim=(-most, most), ylabel="residual / sd")


def ellipse(fitted: jb.Fit, x: str, y: str) -> np.ndarray:
    """The edge of the 95 % confidence region of two parameters, `(2, k)`."""
    centre, errors = (np.array([float(of[name]) for name in (x, y)]) for of in (fitted.theta, fitted.errors))
    rho = fitted.correlations[fitted.names.index(x), fitted.names.index(y)]
    factor = np.linalg.cholesky(np.array([[1.0, rho], [rho, 1.0]]))
    turn = np.linspace(0, 2 * np.pi, 121)
    radius = np.sqrt(-2 * np.log(0.05))  # of a chi-square of two degrees of freedom
    return centre[:, None] + radius * errors[:, None] * (factor @ np.stack([np.cos(turn), np.sin(turn)]))


def draw_regions(ax: Axes, sheet: jb.Fit, full: jb.Fit) -> None:
    """What is known of stiffness and modulus: a valley from positions, cut by the data sheet, and by tensions."""
    x, y = "stiffness", "young"
    rho = sheet.correlations[sheet.names.index(x), sheet.names.index(y)]
    # The modulus at a given stiffness: the ratio of the two, with its error.
    ratio = float(sheet.theta[y]) / float(sheet.theta[x])
    width = 1.96 * float(sheet.errors[y]) * np.sqrt(1 - rho**2) / float(sheet.theta[x])
    inset, along, small = ax.inset_axes((0.62, 0.12, 0.34, 0.36)), np.array([100.0, 400.0]), ellipse(full, x, y)
    for axes in (ax, inset):
        edges = (ratio - width) * along, (ratio + width) * along
        axes.fill_between(along, *edges, color="0.85", lw=0, label="positions")
        axes.plot(*ellipse(sheet, x, y), color=GREEN, lw=1.2, label="positions and data sheet")
        axes.plot(*small, color=LOWER, lw=1.4, label="positions and tensions")
        axes.plot(TRUTH[x], TRUTH[y], "+", color="black", ms=7, mew=1.2, zorder=5, label="truth")
    ax.set(xlim=(170, 330), ylim=(0.25, 0.6), xlabel="stiffness of the tendons (N)", ylabel="Young's modulus (MPa)")
    middle, half = small.mean(axis=1), 0.7 * np.ptp(small, axis=1)
    inset.set(xlim=middle[0] + half[0] * np.array([-1, 1]), ylim=middle[1] + half[1] * np.array([-1, 1]))
    inset.tick_params(labelsize="x-small", pad=2)
    ax.indicate_inset_zoom(inset, edgecolor="0.4")
    ax.legend(loc="upper left", **LEGEND)


def draw_predictions(ax: Axes, truth: np.ndarray, predicted: dict[str, jb.Prediction]) -> None:
    """What the models predict, less the truth."""
    ratios = NEW[:, 0]
    ax.axvspan(ratios.min(), 0.6, color="0.93", zorder=0)
    ax.axhline(0, color="black", lw=0.8, label="truth")
    for (name, each), colour, marker in zip(predicted.items(), (LOWER, UPPER), plot.MARKERS, strict=False):
        off, wide = each.values - truth, 1.96 * each.errors
        ax.plot(ratios, off, color=colour, lw=1.2, marker=marker, ms=3.5, label=name)
        ax.fill_between(ratios, off - wide, off + wide, color=colour, alpha=0.25, lw=0)
        if each.bars is not None:
            edges = np.stack([off - wide - each.bars, off + wide + each.bars], axis=1)
            ax.plot(ratios, edges, ":", color=colour, lw=1, label=["and the mesh's bar", ""])
    ax.text(0.55, ax.get_ylim()[1], "not measured", ha="center", va="bottom", fontsize="x-small")
    ax.set(xlim=(1.0, 0.5), xlabel="ratio of the upper tendon", ylabel="tip angle less truth (degrees)")
    ax.legend(loc="lower left", **LEGEND)


def draw_candidates(ax: Axes, figure: Figure, rows: np.ndarray, share: np.ndarray, best: int) -> None:
    """The error of Poisson's ratio after one more observation, against the commands of that one."""
    side = np.unique(CANDIDATES[:, 0])
    image = ax.pcolormesh(side, side, 100 * share.reshape(len(side), -1), cmap="cividis", shading="nearest")
    figure.colorbar(image, ax=ax, label="error of Poisson's ratio (% of now)")
    ax.plot(*rows.T, "o", ms=3, mfc="white", mec="black", mew=0.5, ls="", label="measured")
    ax.plot(*CANDIDATES[best], "*", ms=13, mfc="white", mec="black", ls="", label="best next")
    ax.set(xlabel="ratio of the upper tendon", ylabel="ratio of the lower tendon", aspect="equal")
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, **LEGEND)


def draw_fit(sheet: jb.Fit, full: jb.Fit, plain: jb.Fit, data: tuple[np.ndarray, np.ndarray, np.ndarray]) -> Figure:
    """Data and fits. `data` are commands, values, and which of these were used."""
    rows, values, used = data
    figure = Figure(figsize=(7.2, 6.0), layout="constrained")
    left, right = figure.subfigures(1, 2, squeeze=False)[0]
    camera, regions = left.subplots(2, 1)
    tensions, triangles, of_rod = right.subplots(3, 1, sharex=True)
    draw_camera(camera, full, rows, values, used)
    draw_regions(regions, sheet, full)
    draw_tensions(tensions, full, values, used)
    draw_residuals(triangles, full, values, used, 5.5)
    draw_residuals(of_rod, plain, values, used, 12.0)
    triangles.legend(ncols=3, columnspacing=0.8, loc="upper left", **LEGEND)
    triangles.set_title(f"triangles: chi-square {full.reduced_chi_square:.2f}", fontsize="medium")
    of_rod.set_title(f"rod: chi-square {plain.reduced_chi_square:.2f}", fontsize="medium")
    of_rod.set_xlabel("observation")
    return figure


# ------------------------------------------------------------------------------------------------------ main


def fit_all(rows: np.ndarray, values: np.ndarray, sd: np.ndarray) -> tuple[dict[str, jb.Fit], list[tuple[int, int]]]:
    """The fits by name, and the values that were left out."""
    measure = measures_of(beam(START))

    def triangles(start: Theta, sd: np.ndarray, prior: Callable[[Theta], jax.Array] | None = None) -> jb.Fit:
        return jb.fit(beam, start, rows, values, measure, sd=sd, bounds=(LOW, HIGH), prior=prior, progress=True)

    print("fitting all (compiles first) ...", flush=True)
    first = triangles(START, sd)
    print(first)
    full, sd, left_out = without_outliers(first, triangles, sd)
    print("left out: " + ", ".join(f"{COLUMNS[j]} of observation {k}" for k, j in left_out))
    print("\nfitting positions alone ...", flush=True)
    positions = np.where(np.arange(len(SD)) < 8, sd, np.inf)
    alone = triangles(START, positions)
    print(alone)
    sheet = triangles(START, positions, lambda theta: (theta["stiffness"] - SHEET) / SHEET_SD)
    print("\nfitting the rod (compiles) ...", flush=True)
    plain = jb.fit(rod, START, rows, values, measures_of_rod, sd=sd, bounds=(LOW, HIGH), progress=True)
    print(plain)
    return {"positions": alone, "and data sheet": sheet, "and tensions": full, "all by a rod": plain}, left_out


def predict_angles(full: jb.Fit, plain: jb.Fit, truth: np.ndarray) -> dict[str, jb.Prediction]:
    """Predictions of the tip angle by triangles and rod."""
    print("\npredicting (compiles) ...", flush=True)
    own, other = jb.predict(full, NEW, jb.tip_angle, bars=True), jb.predict(plain, NEW, jb.tip_angle)
    print(f"{'ratios':15}{'tip angle, degrees':22}{'bar of the mesh':18}{'truth':10}by the rod")
    table = np.column_stack([own.values, own.errors, np.asarray(own.bars), truth, other.values, other.errors])
    for (upper, lower), row in zip(NEW, table, strict=True):
        print(f"{upper:.2f}, {lower:.2f}   " + "{:8.3f} +- {:<10.3f}{:<15.3f}{:8.3f}{:10.3f} +- {:.3f}".format(*row))
    return {"triangles": own, "rod": other}


def next_experiments(full: jb.Fit) -> dict[str, jb.Experiments]:
    """The candidates judged for each parameter."""
    print(f"\n{'next experiment':19}{'error now':12}{'best ratios':15}{'error then':13}at the worst ratios")
    found = {name: jb.next_experiment(full, CANDIDATES, name) for name in TRUTH}
    for name, each in found.items():
        now, after = float(full.errors[name]), each.errors[:, full.names.index(name)]
        best = "{:.2f}, {:.2f}".format(*CANDIDATES[each.best])
        print(f"for {name:15}{now:<12.3g}{best:15}{after[each.best]:<13.3g}{after.max():.3g}")
    return found


def main(out: Path) -> dict[str, float]:
    """Fit, print, draw into the folder `out`; return how good the fits are, and which experiment is best next."""
    out.mkdir(parents=True, exist_ok=True)
    rows, values, sd = read()
    used = np.isfinite(sd)
    print(f"{len(rows)} observations with {used.sum()} values in {DATA.name}")
    fits, left_out = fit_all(rows, values, sd)
    for place in left_out:
        used[place] = False
    show(fits)
    alone, sheet, full, plain = fits.values()
    off = [abs(float(full.theta[name]) - true) / float(full.errors[name]) for name, true in TRUTH.items()]
    print("positions and tensions are off by " + ", ".join(f"{each:.1f}" for each in off) + " standard errors")
    truth = np.loadtxt(TRUE_ANGLES, delimiter=",")[:, 2]
    predicted = predict_angles(full, plain, truth)
    own, other = predicted.values()
    within = np.abs(own.values - truth) <= 1.96 * own.errors + np.asarray(own.bars)
    missed = np.abs(other.values - truth) > 1.96 * other.errors
    found = next_experiments(full)["poisson"]
    print("\ndrawing fit.png and next.png ...", flush=True)
    draw_fit(sheet, full, plain, (rows, values, used)).savefig(out / "fit.png", dpi=200)
    figure = Figure(figsize=(7.2, 3.1), layout="constrained")
    left, right = figure.subplots(1, 2)
    draw_predictions(left, truth, predicted)
    share = found.errors[:, full.names.index("poisson")] / float(full.errors["poisson"])
    draw_candidates(right, figure, rows, share, found.best)
    figure.savefig(out / "next.png", dpi=200)
    print(f"pictures are in {out}")
    upper, lower = CANDIDATES[found.best].tolist()
    return {
        "parameters within 3 errors": float(sum(each < 3 for each in off)),
        "mistakes named": float(sorted(left_out) == sorted(MISTAKES)),
        "known only as a ratio": float(alone.not_determined == ["stiffness and young only as a ratio"]),
        "chi-square": full.reduced_chi_square,
        "chi-square of the rod": plain.reduced_chi_square,
        "angles within": float(within.sum()),
        "angles missed by the rod": float(missed.sum()),
        "next upper ratio": upper,
        "next lower ratio": lower,
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/fit"), help="folder for the pictures")
    parser.add_argument("--make", action="store_true", help="make up the measurements anew")
    arguments = parser.parse_args()
    if arguments.make:
        make()
    main(arguments.out)
