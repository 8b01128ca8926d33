"""The extremes grid: what jaxbeam answers where a scene is pushed too far, and whether the answer is true.

    python -m benchmarks.extremes [--quick] [--out out/extremes]

Every case is one scene and one command, solved in one call (`jump`, by `equilibrium`) or by a `ramp` of 28
steps. Every answer, each step of a ramp too, is verified by `tests/verify.py`, which shares no code with the
solver. A case counts as *reachable* if it was solved, or if a ramp of 280 steps in float64 solves it; a *miss*
is a reachable case that was not solved. The goals: no claim refuted, no NaN without a flag, 95 % of the reachable
cases solved in one call and 99 % by the ramp. The exit code is 1 if a claim was refuted.

Reachable is judged in float64 for float32 too. There a tangent stiffness whose condition number is far over 1 / eps,
about 1e7, has no usable factor: beams of a fiftieth of their length, or beside tendons 1e4 times the reference. These
misses are flagged `INACCURATE`.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import os
import platform
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

# The dense checks are many and small: threads that wait for each other cost more than they give.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import numpy as np

import jaxbeam as jb
from tests.verify import Problem, verify

MATERIALS = (jb.macklin_mueller, jb.neo_hookean, jb.saint_venant_kirchhoff, jb.linear_elastic)
LAWS = {
    "inverse-square": jb.inverse_square_stiffness,
    "inverse": jb.inverse_stiffness,
    "constant": jb.constant_stiffness,
}
RATIOS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 0.95, 1.05, 1.2, 1.5, 2.0, 3.0)
PATTERNS = ("top", "bottom", "both", "opposed")
POISSON = (0.0, 0.2, 0.3, 0.45, 0.49, 0.499, 0.4999)
FACTORS = (1e-3, 1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6)
# Height over length, or the element's width over its height.
SHAPES = (
    *(("slender", value) for value in (1 / 50, 0.1, 0.8 / 3.5, 1.0)),
    *(("element", value) for value in (100.0, 10.0, 0.1, 0.01)),
)
LENGTH, YOUNG, MODULUS = 3.5, 1e4, 2e3
RAMP, FINE = 28, 280
# Stability is checked at every step of a ramp up to this many unknowns, beyond at its last step only.
DENSE_EVERY = 600


@dataclasses.dataclass(frozen=True)
class Group:
    """Cases that share one compiled program: mesh, material, tendon law and dtype. `count` scenes."""

    nx: int
    ny: int
    diagonals: str
    material: str
    law: str
    dtype: str
    count: int

    def __str__(self) -> str:
        return f"{self.nx}x{self.ny} {self.diagonals}, {self.material}, {self.law}, {self.dtype}"


@dataclasses.dataclass(frozen=True)
class Case:
    """One scene and command: `ratio` in a `pattern`, `factor` times the reference tendon's modulus."""

    ratio: float = 0.4
    pattern: str = "top"
    poisson: float = 0.45
    factor: float = 1.0
    shape: tuple[str, float] = ("slender", 0.8 / 3.5)

    def ratios(self) -> np.ndarray:
        other = 2 - self.ratio if self.ratio < 1 else 1 / self.ratio
        pair = {"top": (self.ratio, 1), "bottom": (1, self.ratio), "both": (self.ratio, self.ratio)}
        return np.array(pair.get(self.pattern, (self.ratio, other)))

    def height(self, group: Group) -> float:
        kind, value = self.shape
        slender = value if kind == "slender" else (group.ny - 1) / (group.nx - 1) / value
        return LENGTH * max(slender, 1 / 50)


def groups() -> list[Group]:
    """The programs that are compiled, cheapest first."""
    mm, nh, svk, linear = (m.__name__ for m in MATERIALS)
    two, one = ("float64", "float32"), ("float64",)
    plan = [
        # nx, ny, diagonals, materials, laws, dtypes, scenes
        (3, 2, "one-sided", (mm, nh), ("inverse-square",), two, 60),
        (3, 2, "one-sided", (svk, linear), ("inverse-square",), one, 50),
        (3, 11, "mirrored", (mm, nh), ("inverse-square",), two, 50),
        (15, 5, "one-sided", (nh,), ("inverse", "constant"), one, 40),
        (15, 5, "mirrored", (mm, nh, svk), ("inverse-square",), two, 60),
        (15, 5, "crossed", (mm,), ("inverse-square",), two, 40),
        (29, 7, "one-sided", (mm, nh), ("inverse-square",), two, 70),
        (29, 7, "mirrored", (svk, linear), ("inverse-square",), one, 16),
        (29, 7, "crossed", (nh,), ("inverse-square",), one, 30),
        (57, 13, "one-sided", (mm, nh), ("inverse-square",), two, 10),
        (113, 25, "one-sided", (mm, nh), ("inverse-square",), one, 4),
        (113, 25, "mirrored", (mm,), ("inverse-square",), ("float32",), 4),
    ]
    return [
        Group(nx, ny, diagonals, material, law, dtype, count)
        for nx, ny, diagonals, materials, laws, dtypes, count in plan
        for material, law, dtype in itertools.product(materials, laws, dtypes)
    ]


def cases(group: Group, count: int) -> list[Case]:
    """Scenes of one group, the same in every run: half vary one axis of the reference, half vary them all."""
    axes = [Case(ratio=r, pattern=p) for r, p in itertools.product(RATIOS, PATTERNS)]
    for ratio, pattern in ((0.4, "top"), (0.05, "both"), (2.0, "opposed")):
        axes += [Case(ratio, pattern, poisson=v) for v in POISSON]
        axes += [Case(ratio, pattern, factor=v) for v in FACTORS]
        axes += [Case(ratio, pattern, shape=v) for v in SHAPES]
    random = np.random.default_rng(seed(str(group)))
    single = [axes[i] for i in np.sort(random.permutation(len(axes))[: (count + 1) // 2])]
    pick = lambda values: values[random.integers(len(values))]
    joint = [Case(pick(RATIOS), pick(PATTERNS), pick(POISSON), pick(FACTORS), pick(SHAPES)) for _ in range(count // 2)]
    return single + joint


def seed(text: str) -> int:
    """A seed that does not change from run to run, as `hash` of a string does."""
    return int.from_bytes(text.encode(), "big") % (2**31 - 1)


def build(group: Group, case: Case, dtype: str) -> tuple[jb.Scene, Problem]:
    """The scene, and the raw arrays that the verification starts from."""
    modulus = case.factor * MODULUS
    if group.law != "inverse-square":
        # The same stiffness as the reference law at rest, whatever the law's unit.
        modulus /= (LENGTH / 2) ** {"inverse": 1, "constant": 2}[group.law]
    scene = jb.tendon_beam(
        group.nx,
        group.ny,
        LENGTH,
        case.height(group),
        YOUNG,
        case.poisson,
        modulus,
        diagonals=group.diagonals,
        density=getattr(jb, group.material),
        stiffness=LAWS[group.law],
        dtype=dtype,
    )
    middle = (group.nx - 1) // 2 * group.ny
    lines = np.array([[group.ny - 1, middle + group.ny - 1], [0, middle]])
    fixed = np.zeros(scene.mesh.nodes.shape, bool)
    fixed[: group.ny] = True
    problem = Problem(
        np.asarray(scene.mesh.nodes),
        scene.mesh.elements,
        fixed,
        YOUNG,
        case.poisson,
        group.material,
        lines,
        modulus,
        group.law,
    )
    return scene, problem


def solve(method: str, scene: jb.Scene, ratios: np.ndarray, steps: int = RAMP) -> tuple[jb.Solution, float]:
    """A `Solution` with a leading axis, on the host, and the seconds it took."""
    start = time.perf_counter()
    found = jb.equilibrium(jb.command(scene, ratios)) if method == "jump" else jb.ramp(scene, ratios, steps)
    found = jax.tree.map(np.asarray, found)
    seconds = time.perf_counter() - start
    return (jax.tree.map(lambda leaf: leaf[None], found) if method == "jump" else found), seconds


def judge(method: str, problem: Problem, ratios: np.ndarray, found: jb.Solution) -> dict[str, Any]:
    """Verify every answer of one case; the verdict on the last, with whatever was refuted on the way."""
    count = len(found.status)
    way = ratios[None] if method == "jump" else np.asarray(jb.commands(ratios.astype(found.x.dtype), count))
    unknowns = int(np.sum(~problem.fixed))
    refuted: list[str] = []
    broken = np.flatnonzero(found.status & jb.Status.NOT_CONVERGED)
    checked = 0
    for k in range(count):
        answer = jax.tree.map(lambda leaf, k=k: leaf[k], found)
        if broken.size and k > broken[0]:
            # The walk has ended; what follows repeats where.
            if not answer.status & jb.Status.NOT_CONVERGED or not np.array_equal(answer.x, found.x[broken[0]]):
                refuted.append(f"step {k}: not the state in which the ramp broke off")
            continue
        last = k == count - 1
        verdict = verify(problem, way[k], answer, stability=last or unknowns <= DENSE_EVERY)
        checked += 1
        refuted += [f"step {k}: {text}" if method == "ramp" else text for text in verdict.refuted]
    return {
        "refuted": refuted,
        "verified": checked,
        "true_residual": verdict.residual,
        "true_volume": verdict.volume,
        "off": verdict.off,
        "marginal": verdict.marginal,
    }


def run_group(group: Group, count: int, fine: bool) -> list[dict[str, Any]]:
    """Solve and verify all cases of one group."""
    records = []
    for method in ("jump", "ramp"):
        start = time.perf_counter()
        solve(method, build(group, Case(), group.dtype)[0], np.ones(2))
        first = time.perf_counter() - start
        for case in cases(group, count):
            scene, problem = build(group, case, group.dtype)
            ratios = case.ratios()
            found, seconds = solve(method, scene, ratios)
            status = int(found.status[-1])
            record = {
                "group": str(group),
                "method": method,
                **dataclasses.asdict(case),
                "height": case.height(group),
                "ratios": ratios.tolist(),
                "status": jb.Status(status).name,
                "residual": float(found.residual[-1]),
                "smallest_jacobian": float(found.smallest_jacobian[-1]),
                "reached": float(found.reached[-1]),
                "stopped_at": int(np.argmax(found.status != 0)) if status else len(found.status),
                "steps": int(found.steps.sum()),
                "attempts": int(found.attempts.max()),
                "seconds": seconds,
                "first_call_seconds": first,
                **judge(method, problem, ratios, found),
            }
            if status == 0:
                record["reachable"] = True
            elif fine:
                finest, _ = solve("ramp", build(group, case, "float64")[0], ratios, FINE)
                record["reachable"] = int(finest.status[-1]) == 0
                record["fine"] = jb.Status(int(finest.status[-1])).name
            records.append(record)
    return records


HEADER = (
    f"{'group':60} {'':5} {'cases':>5} {'OK':>5} {'NCONV':>5} {'NONFI':>5} {'INV':>4} {'UNST':>4} {'miss':>4} "
    f"{'refuted':>7} {'steps':>11} {'att':>4} {'ms':>13} {'off':>8}"
)


def row(name: str, method: str, records: list[dict[str, Any]]) -> str:
    """One line of the table."""
    flags = Counter(flag for r in records if r["status"] != "OK" for flag in r["status"].split("|"))
    steps, ms = (np.array([r[key] for r in records]) for key in ("steps", "seconds"))
    misses = sum(r.get("reachable", False) and r["status"] != "OK" for r in records)
    off = max((r["off"] for r in records if np.isfinite(r["off"])), default=0.0)
    return (
        f"{name:60} {method:5} {len(records):5} {sum(r['status'] == 'OK' for r in records):5} "
        f"{flags['NOT_CONVERGED']:5} {flags['NONFINITE']:5} {flags['INVERTED']:4} {flags['UNSTABLE']:4} {misses:4} "
        f"{sum(bool(r['refuted']) for r in records):7} {np.median(steps):5.0f}/{steps.max():5} "
        f"{max(r['attempts'] for r in records):4} {1e3 * np.median(ms):6.1f}/{1e3 * ms.max():6.0f} {off:8.1e}"
    )


def describe(record: dict[str, Any]) -> str:
    """One case in words, enough to repeat it."""
    return (
        f"{record['group']}, {record['method']}: ratios {record['ratios']}, poisson {record['poisson']}, modulus x "
        f"{record['factor']:g}, height {record['height']:.4g}: "
        f"{record['status']}, reached {record['reached']:.4g} (step {record['stopped_at']}), smallest J "
        f"{record['smallest_jacobian']:.3g}, residual {record['residual']:.3g}, {record['steps']} steps"
    )


def summarise(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts and percentages over all cases."""
    summary: dict[str, Any] = {"cases": len(records), "states_verified": sum(r["verified"] for r in records)}
    summary["refuted"] = sum(bool(r["refuted"]) for r in records)
    summary["ok_but_off_by_a_thousandth"] = sum(r["status"] == "OK" and r["off"] > 1e-3 for r in records)
    summary["stable_within_round_off"] = sum(r["marginal"] for r in records)
    for method in ("jump", "ramp"):
        own = [r for r in records if r["method"] == method]
        reachable = [r for r in own if r.get("reachable")]
        solved = sum(r["status"] == "OK" for r in reachable)
        summary[method] = {
            "cases": len(own),
            "reachable": len(reachable),
            "solved": solved,
            "percent": 100 * solved / max(1, len(reachable)),
            "statuses": dict(Counter(r["status"] for r in own)),
        }
        for dtype in ("float64", "float32"):
            alike = [r["status"] == "OK" for r in reachable if r["group"].endswith(dtype)]
            summary[method][f"percent_{dtype}"] = 100 * sum(alike) / max(1, len(alike))
    for dtype in ("float64", "float32"):
        off = [
            r["off"] for r in records if r["group"].endswith(dtype) and r["status"] == "OK" and np.isfinite(r["off"])
        ]
        if off:
            shown = zip(("median", "99 %", "largest"), np.quantile(off, [0.5, 0.99, 1.0]), strict=True)
            summary[f"error_of_positions_{dtype}"] = {name: float(value) for name, value in shown}
    return summary


def versions() -> dict[str, str]:
    """What the figures depend on."""
    model = next((line for line in _lines("/proc/cpuinfo") if line.startswith("model name")), platform.processor())
    return {
        "jaxbeam": jb.__version__,
        "jax": jax.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "device": jax.devices()[0].device_kind,
        "processor": model.split(":")[-1].strip(),
        "cores": str(os.cpu_count()),
    }


def _lines(path: str) -> list[str]:
    return Path(path).read_text().splitlines() if Path(path).exists() else []


def main(arguments: list[str] | None = None) -> int:
    """Run the grid; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a few cases of a few groups")
    parser.add_argument("--only", default="", help="only groups whose name contains this")
    parser.add_argument("--out", type=Path, default=Path("out/extremes"), help="folder for the JSON file")
    options = parser.parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    plan = [(g, g.count) for g in groups() if options.only in str(g)]
    if options.quick:
        plan = [(g, 20) for g, _ in plan if g.nx in (15, 29)][::3]
    print(", ".join(f"{name} {value}" for name, value in versions().items()), flush=True)
    print(HEADER, flush=True)
    options.out.mkdir(parents=True, exist_ok=True)
    records: list[dict[str, Any]] = []
    start = time.perf_counter()
    for group, count in plan:
        records += (new := run_group(group, count, fine=not options.quick))
        for method in ("jump", "ramp"):
            print(row(str(group), method, [r for r in new if r["method"] == method]), flush=True)
        summary = {"versions": versions(), "seconds": time.perf_counter() - start, **summarise(records)}
        (options.out / "extremes.json").write_text(json.dumps({"summary": summary, "cases": records}, indent=1))
    for title, shown in (
        ("Refuted", [r for r in records if r["refuted"]]),
        ("Misses", [r for r in records if r.get("reachable") and r["status"] != "OK"]),
        ("Positions off by a thousandth", [r for r in records if r["status"] == "OK" and r["off"] > 1e-3]),
        ("Unreachable", [r for r in records if not r.get("reachable", True)]),
    ):
        print(f"\n{title}: {len(shown)}")
        for record in shown:
            print("-", describe(record), *(f"\n    {text}" for text in record["refuted"][:4]))
    print("\n" + json.dumps(summary, indent=1))
    return int(any(r["refuted"] for r in records))


if __name__ == "__main__":
    sys.exit(main())
