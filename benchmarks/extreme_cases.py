"""The cases of `benchmarks.extremes`: groups that share one compiled program, and the scenes of each.

The beams of the kind `"beam"` vary what a tendon beam of three-node triangles is made of. Every other kind varies what
its name says (`KNOBS`), alone at a moderate command in half of its cases and all at once at any command in the other.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

import jaxbeam as jb
from jaxbeam.mesh.rectangle import middle_column
from tests.energies import Problem, Tendons
from tests.helpers import scene_of

RATIOS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 0.95, 1.05, 1.2, 1.5, 2.0, 3.0)
MODERATE = (0.4, 0.6, 0.8, 0.95, 1.2)
PATTERNS = ("top", "bottom", "both", "opposed")
POISSON = (0.0, 0.2, 0.3, 0.45, 0.49, 0.499, 0.4999)
FACTORS = (1e-3, 1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6)
# Height over length, or the element's width over its height.
SHAPES = (
    *(("slender", value) for value in (1 / 50, 0.1, 0.8 / 3.5, 1.0)),
    *(("element", value) for value in (100.0, 10.0, 0.1, 0.01)),
)
MODULI = (1e-6, 1e-3, 1.0, 1e3, 1e6, 1e9, 1e12)
# Where the body lies, and the units of length and stress, in float64 and in float32.
OFFSETS = {"float64": (1e2, 1e4, 1e6, 1e8, 1e9, 1e10, 1e11, 1e12), "float32": (1.0, 10.0, 1e2, 3e2, 1e3, 4e3, 1e4)}
UNITS = {"float64": (1e-12, 1e-8, 1e-4, 1.0, 1e4, 1e8, 1e12), "float32": (1e-6, 1e-3, 1.0, 1e3, 1e6)}
LENGTH, YOUNG, MODULUS = 3.5, 1e4, 2e3
# Of the half-widths of anchors that are not nodes.
WIDE = 0.25


@dataclasses.dataclass(frozen=True)
class Group:
    """Cases that share one compiled program: mesh, material, tendon law and dtype. `count` scenes of a `kind`.

    `order` 2 are triangles of six nodes, and `width` is that of the anchors.
    """

    nx: int
    ny: int
    diagonals: str
    material: str
    law: str
    dtype: str
    count: int
    kind: str = "beam"
    order: int = 1
    graded: bool = False
    width: float = 0.0

    def __str__(self) -> str:
        told = [
            name for name, yes in (("six-node", self.order == 2), ("graded", self.graded), ("wide", self.width)) if yes
        ]
        mesh = f"{self.nx} nodes" if self.kind == "rod" else " ".join([f"{self.nx}x{self.ny}", self.diagonals, *told])
        kind = "" if self.kind == "beam" else f"{self.kind}: "
        return f"{kind}{mesh}, {self.material}, {self.law}, {self.dtype}"


@dataclasses.dataclass(frozen=True)
class Case:
    """One scene and command: `ratio` in a `pattern`, `factor` times the reference tendon's modulus.

    others: ratio of all further tendons. clamped, mixed, wild: moduli of a tendon between two clamped nodes, from a
    clamped to a free one, and between two free ones. contrast: decades of Young's modulus, in a `layout`. load: on the
    tip. length, stress: the units.
    offset: of the body from the origin, in units of length.
    """

    ratio: float = 0.4
    pattern: str = "top"
    poisson: float = 0.45
    factor: float = 1.0
    shape: tuple[str, float] = ("slender", 0.8 / 3.5)
    others: float = 0.9
    clamped: float = 1.0
    mixed: float = 1.0
    wild: float = 1.0
    contrast: float = 0.0
    layout: str = "random"
    load: float = 1e-6
    offset: float = 0.0
    length: float = 1.0
    stress: float = 1.0

    def ratios(self, count: int = 2) -> np.ndarray:
        other = 2 - self.ratio if self.ratio < 1 else 1 / self.ratio
        pair = {"top": (self.ratio, 1), "bottom": (1, self.ratio), "both": (self.ratio, self.ratio)}
        return np.append(pair.get(self.pattern, (self.ratio, other)), [self.others] * (count - 2))

    def height(self, group: Group) -> float:
        kind, value = self.shape
        slender = value if kind == "slender" else (group.ny - 1) / (group.nx - 1) / value
        return LENGTH * max(slender, 1 / 50)

    def changes(self) -> dict[str, Any]:
        """What is not as in the reference scene."""
        return {f.name: v for f in dataclasses.fields(self) if (v := getattr(self, f.name)) != f.default}


# What each kind varies, by dtype.
BODY: dict[str, tuple] = {"poisson": POISSON, "factor": FACTORS, "shape": SHAPES}
# Never none: all cases of a group have the same terms.
LOADS = (1.0, -30.0, 100.0)
KNOBS: dict[str, Callable[[str], dict[str, tuple]]] = {
    "six nodes": lambda dtype: BODY,
    "graded": lambda dtype: BODY,
    "curved": lambda dtype: {"poisson": POISSON, "factor": FACTORS, "load": LOADS},
    "offset": lambda dtype: {"offset": OFFSETS[dtype], "factor": FACTORS[2:6]},
    "moduli": lambda dtype: {"clamped": MODULI, "mixed": MODULI, "wild": MODULI, "others": (0.5, 0.9, 1.0, 1.1)},
    "guides": lambda dtype: {"others": RATIOS[3:], "factor": FACTORS, "load": LOADS, "poisson": POISSON},
    "contrast": lambda dtype: {
        "contrast": (1.0, 3.0, 6.0),
        "layout": ("random", "halves", "layers"),
        "factor": FACTORS,
    },
    "units": lambda dtype: {"length": UNITS[dtype], "stress": UNITS[dtype]},
    "both ends": lambda dtype: {**BODY, "load": LOADS},
    "roller": lambda dtype: {**BODY, "load": LOADS},
    "two bodies": lambda dtype: {**BODY, "others": RATIOS},
    "rod": lambda dtype: {
        "poisson": POISSON,
        "factor": FACTORS,
        "shape": SHAPES[:4],
        "load": LOADS,
        "offset": OFFSETS[dtype],
        "length": UNITS[dtype],
    },
}


def groups() -> list[Group]:
    """The programs that are compiled."""
    mm, nh, svk, linear = "macklin_mueller", "neo_hookean", "saint_venant_kirchhoff", "linear_elastic"
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
    beams = [
        Group(nx, ny, diagonals, material, law, dtype, count)
        for nx, ny, diagonals, materials, laws, dtypes, count in plan
        for material, law, dtype in itertools.product(materials, laws, dtypes)
    ]
    six, wide = {"order": 2}, {"order": 2, "graded": True, "width": WIDE}
    themed = [
        # kind, nx, ny, diagonals, materials, dtypes, scenes, what else
        ("six nodes", 5, 3, "crossed", (mm,), two, 24, six),
        ("six nodes", 9, 5, "one-sided", (mm, nh), two, 16, wide),
        ("six nodes", 7, 4, "crossed", (nh,), one, 16, wide),
        ("six nodes", 17, 6, "crossed", (mm,), one, 6, wide),
        ("graded", 15, 5, "one-sided", (mm,), one, 16, {"graded": True, "width": WIDE}),
        ("curved", 7, 3, "one-sided", (mm, nh), one, 16, {**six, "width": 0.4}),
        ("offset", 9, 5, "one-sided", (mm,), two, 24, {}),
        ("offset", 5, 3, "crossed", (nh,), two, 16, {**six, "width": 0.4}),
        ("moduli", 9, 5, "one-sided", (mm,), two, 32, {}),
        ("guides", 9, 5, "one-sided", (mm, nh), two, 16, {}),
        ("contrast", 9, 5, "one-sided", (mm, nh), two, 16, {}),
        ("units", 9, 5, "one-sided", (mm,), two, 20, {}),
        ("units", 5, 3, "crossed", (nh,), one, 16, {**six, "width": 0.4}),
        ("both ends", 9, 5, "one-sided", (mm, nh), two, 16, {}),
        ("roller", 9, 5, "crossed", (mm,), one, 16, {}),
        ("two bodies", 5, 3, "mirrored", (mm, nh), two, 24, {}),
        ("two bodies", 9, 5, "one-sided", (mm,), one, 16, {}),
        ("rod", 9, 2, "", (mm, nh, linear), one, 24, {}),
        ("rod", 9, 2, "", (mm,), ("float32",), 24, {}),
    ]
    return beams + [
        Group(nx, ny, diagonals, material, "inverse-square", dtype, count, kind, **more)
        for kind, nx, ny, diagonals, materials, dtypes, count, more in themed
        for material, dtype in itertools.product(materials, dtypes)
    ]


def cases(group: Group, count: int) -> list[Case]:
    """Scenes of one group, the same in every run: half vary one axis of the reference, half vary them all."""
    random = np.random.default_rng(seed(str(group)))
    if group.kind != "beam":
        return _themed(KNOBS[group.kind](group.dtype), count, random)
    axes = [Case(ratio=r, pattern=p) for r, p in itertools.product(RATIOS, PATTERNS)]
    for ratio, pattern in ((0.4, "top"), (0.05, "both"), (2.0, "opposed")):
        axes += [Case(ratio, pattern, poisson=v) for v in POISSON]
        axes += [Case(ratio, pattern, factor=v) for v in FACTORS]
        axes += [Case(ratio, pattern, shape=v) for v in SHAPES]
    single = [axes[i] for i in np.sort(random.permutation(len(axes))[: (count + 1) // 2])]
    pick = lambda values: values[random.integers(len(values))]
    joint = [Case(pick(RATIOS), pick(PATTERNS), pick(POISSON), pick(FACTORS), pick(SHAPES)) for _ in range(count // 2)]
    return single + joint


def _themed(knobs: dict[str, tuple], count: int, random: np.random.Generator) -> list[Case]:
    """Half of the cases turn one knob each, to every value in turn; half turn them all."""
    pick = lambda values: values[random.integers(len(values))]
    orders = {name: random.permutation(len(values)) for name, values in knobs.items()}
    single = []
    for k in range((count + 1) // 2):
        turn, which = divmod(k, len(knobs))
        name = list(knobs)[which]
        value = knobs[name][orders[name][turn % len(orders[name])]]
        single.append(Case(pick(MODERATE), pick(PATTERNS), **{name: value}))
    every = lambda: {name: pick(values) for name, values in knobs.items()}
    return single + [Case(pick(RATIOS), pick(PATTERNS), **every()) for _ in range(count // 2)]


def seed(text: str) -> int:
    """A seed that does not change from run to run, as `hash` of a string does."""
    return int.from_bytes(text.encode(), "big") % (2**31 - 1)


def build(group: Group, case: Case, dtype: str) -> tuple[jb.Scene, Problem]:
    """The scene, and the raw arrays that the verification starts from."""
    if group.kind == "rod":
        raw = _rod(group, case, dtype)
        return scene_of(raw, np.array([group.nx - 1])), raw
    raw = _solid(group, case, dtype)
    column = middle_column(group.nx, group.graded) if group.kind == "both ends" else group.nx - 1
    return scene_of(raw, column * group.ny + np.arange(group.ny)), raw


def _solid(group: Group, case: Case, dtype: str) -> Problem:
    height, ny = case.height(group), group.ny
    mesh = jb.rectangle(LENGTH, height, group.nx, ny, group.diagonals, dtype, order=group.order, graded=group.graded)
    if group.kind == "two bodies":
        mesh = _twice(mesh, height)
    plain = np.asarray(mesh.nodes, np.float64)
    low, high = plain[:, 0] < -0.4999 * LENGTH, plain[:, 0] > 0.4999 * LENGTH
    fixed = np.repeat(low[:, None], 2, axis=1)
    if group.kind == "both ends":
        fixed[high] = True
    if group.kind == "roller":
        fixed[high, 1] = True
    nodes = np.asarray(mesh.nodes)
    if group.kind == "curved":
        nodes = nodes + 0.05 * plain[:, :1] ** 2 * [0, 1]
    if (case.length, case.offset) != (1, 0):
        nodes = case.length * (nodes.astype(np.float64) + case.offset * np.array([1.0, 0.5]))
    load = None
    if "load" in (KNOBS[group.kind](dtype) if group.kind != "beam" else {}):
        # On a node that is free in both directions.
        load = np.zeros(nodes.shape)
        load[(group.nx - 2) * ny + ny - 1] = case.load * np.array([0.1, 1.0])
    return Problem(
        nodes.astype(dtype),
        mesh.elements,
        fixed,
        case.stress * YOUNG * _contrast(case, plain[mesh.elements].mean(axis=1), group),
        case.poisson,
        group.material,
        _tendons(group, case),
        load=load,
    )


def _twice(mesh: jb.Mesh, height: float) -> jb.Mesh:
    """The body, and another above it that nothing joins to it. Its nodes follow those of the first."""
    nodes, elements = np.asarray(mesh.nodes), np.asarray(mesh.elements)
    above = nodes + np.array([0.0, 2 * height + LENGTH], nodes.dtype)
    return jb.Mesh(np.concatenate([nodes, above]), np.concatenate([elements, elements + len(nodes)]))


def _contrast(case: Case, centres: np.ndarray, group: Group) -> Any:
    """Young's modulus of each element over the reference, from one to so many decades."""
    if group.kind != "contrast":
        return 1.0
    layouts = {
        "random": np.random.default_rng(0).uniform(-0.5, 0.5, len(centres)),
        "halves": np.where(centres[:, 0] > 0, 0.5, -0.5),
        "layers": np.where(centres[:, 1] > 0, 0.5, -0.5),
    }
    return 10 ** (case.contrast * layouts[case.layout])


def _tendons(group: Group, case: Case) -> tuple[Tendons, ...]:
    """The two of the reference scene, and those of the kind."""
    unit = case.stress * case.length**2

    def modulus(law: str, factor: float) -> float:
        # The same stiffness as the reference law at rest, whatever the law's unit.
        return (
            factor
            * MODULUS
            * unit
            / (case.length * LENGTH / 2) ** {"inverse-square": 0, "inverse": 1, "constant": 2}[law]
        )

    ny, middle = group.ny, middle_column(group.nx, group.graded) * group.ny
    lines = np.array([[ny - 1, middle + ny - 1], [0, middle]])
    widths = case.length * np.array([[0.0, group.width]] * 2)
    pair = Tendons(lines, modulus(group.law, case.factor), group.law, widths)
    if group.kind == "two bodies":
        both = np.concatenate([lines, lines + group.nx * ny])
        return (Tendons(both, modulus(group.law, case.factor), group.law, np.concatenate([widths, widths])),)
    at = lambda *places: [column * ny + row for column, row in places]
    if group.kind == "moduli":
        more = np.array([at((0, 0), (0, ny - 1)), at((0, 2), (6, 2)), at((5, 1), (7, 3))])
        return (pair, Tendons(more, np.array([case.clamped, case.mixed, case.wild]), "inverse-square"))
    if group.kind == "guides":
        one = np.array([at((0, 2), (2, 3), (5, 1))])
        many = np.array([at((0, 3), (1, 4), (3, 3), (6, 4)), at((0, 1), (2, 0), (4, 1), (7, 0))])
        return (
            pair,
            Tendons(one, modulus("inverse", case.factor), "inverse"),
            Tendons(many, modulus("constant", 0.3), "constant"),
        )
    return (pair,)


def _rod(group: Group, case: Case, dtype: str) -> Problem:
    """The reference scene as a rod of `nx` nodes."""
    height, middle = case.length * case.height(group), (group.nx - 1) // 2
    along = LENGTH * np.linspace(-0.5, 0.5, group.nx)
    nodes = case.length * np.stack([along + case.offset, 0 * along + case.offset / 2, 0 * along], axis=1)
    fixed, load = np.zeros(nodes.shape, bool), np.zeros(nodes.shape)
    fixed[0] = True
    load[-1] = case.load * case.stress * case.length * np.array([0.0, 0.3, 0.1])
    sides = 0.5 * height * np.array([[1.0, 1.0], [-1.0, -1.0]])
    modulus = case.factor * MODULUS * case.stress * case.length**2
    return Problem(
        nodes.astype(dtype),
        np.stack([np.arange(group.nx - 1), np.arange(1, group.nx)], axis=1),
        fixed,
        case.stress * YOUNG,
        case.poisson,
        group.material,
        (Tendons(np.array([[0, middle]] * 2), modulus, group.law, aside=sides),),
        load=load,
        height=height,
        radian=height,
    )
