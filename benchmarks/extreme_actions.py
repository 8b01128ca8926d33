"""The cases of `benchmarks.extremes` for what else acts on a beam: cables, tensions, loads, contact and supports.

A group is as in `benchmarks/extreme_cases.py`. Half of its cases turn one knob of their kind (`KNOBS`) to each value in
turn, and half turn them all.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

import jaxbeam as jb
from benchmarks import extreme_cases
from benchmarks.extreme_cases import FACTORS, LENGTH, MODULUS, OFFSETS, POISSON, RATIOS, UNITS, WIDE, YOUNG, Group, seed
from jaxbeam.mesh.rectangle import middle_column
from tests.actions import Action, Cables, Pressure, Pulls, Support, Tendons, Traction, Weight
from tests.energies import Problem
from tests.helpers import scene_of
from tests.obstacles import Contact

HEIGHT = 0.8
DECADES = (1e-9, 1e-6, 1e-4, 1e-3, 1e-2, 0.03, 0.1, 0.3, 1.0, 10.0, 100.0)
TRANSITIONS = (1e-4, 1e-3, 1e-2, 1e-1)
ANGLES = (0.0, 30.0, 90.0, 135.0, 180.0, 270.0)


@dataclasses.dataclass(frozen=True)
class Push:
    """One scene and command. Forces are over Young's modulus and the length or area that they act on.

    ratios: of the two cables, or of the tendons beside the kind. tension, second: of two cables. weight, traction:
    their sizes; turn: their direction in degrees. pressure. stiffness: of contact, over the reference Young's modulus
    times length. transition: of a cable over its length, of contact over the length of the beam. size: of the obstacle,
    over the reference. pushed: how far it is moved, over the height of the beam, in a direction in degrees, toward.
    stretch: length over that at rest. shear: how far a grip is moved across, over the length of the beam. factor: of
    the modulus of the tendons or cables.
    """

    top: float = 0.9
    bottom: float = 1.0
    tension: float = 0.03
    second: float = 0.0
    weight: float = 1e-3
    traction: float = 1e-3
    turn: float = 270.0
    pressure: float = 0.01
    stiffness: float = 1e5
    transition: float = 1e-2
    size: float = 1.0
    pushed: float = 0.3
    toward: float = 90.0
    stretch: float = 1.1
    shear: float = 0.0
    factor: float = 1.0
    poisson: float = 0.45
    slender: float = HEIGHT / LENGTH
    offset: float = 0.0
    length: float = 1.0
    stress: float = 1.0

    def height(self, group: Group) -> float:
        return LENGTH * self.slender

    def changes(self) -> dict[str, Any]:
        """What is not as in the reference scene."""
        return {f.name: v for f in dataclasses.fields(self) if (v := getattr(self, f.name)) != f.default}


UNIT: Callable[[str], dict[str, tuple]] = lambda dtype: {
    "length": UNITS[dtype],
    "stress": UNITS[dtype],
    "offset": OFFSETS[dtype][:4],
}
BODY = {"poisson": POISSON[3:6], "slender": (1 / 50, 0.1, HEIGHT / LENGTH, 1.0)}
SIGNED = tuple(sign * value for value in DECADES for sign in (1, -1))
CONTACT: dict[str, tuple] = {
    "pushed": (-0.5, 0.0, 0.05, 0.3, 1.0, 2.0, 5.0),
    "stiffness": (1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9),
    "transition": TRANSITIONS,
    "top": RATIOS[3:],
    "size": (0.4, 1.0, 3.0, 30.0),
    "toward": (30.0, 90.0, 120.0),
}
KNOBS: dict[str, dict[str, tuple]] = {
    "cables": {"top": RATIOS, "bottom": RATIOS, "factor": FACTORS, "transition": TRANSITIONS},
    "pulls": {"tension": DECADES, "second": (0.0, *DECADES), "top": RATIOS[3:], "factor": FACTORS[:6]},
    "loads": {"weight": DECADES, "traction": DECADES, "pressure": SIGNED, "turn": ANGLES},
    "loads both ends": {"weight": DECADES, "traction": DECADES, "pressure": SIGNED, "turn": ANGLES},
    "loads cavity": {"weight": DECADES, "traction": DECADES, "pressure": SIGNED, "turn": ANGLES},
    "contact half-plane": CONTACT,
    "contact disk": CONTACT,
    "contact box": CONTACT,
    "supports": {"stretch": (0.3, 0.5, 0.7, 0.9, 0.99, 1.01, 1.3, 2.0, 3.0), "shear": (-1.0, -0.3, 0.0, 0.1, 0.5)},
    "supports sliding": {"stretch": (0.3, 0.5, 0.8, 0.99, 1.3, 3.0), "shear": (-0.3, 0.0, 0.1), "top": RATIOS[3:]},
    "everything": CONTACT | {"stretch": (0.8, 0.99, 1.1, 1.5), "tension": DECADES[:8]},
}


def groups() -> list[Group]:
    """The programs that are compiled, those of all other kinds too."""
    mm, nh = "macklin_mueller", "neo_hookean"
    plan = [
        # kind, nx, ny, diagonals, material, scenes in float64 and in float32, what else
        ("cables", 9, 5, "one-sided", mm, 40, 30, {}),
        ("cables", 15, 5, "mirrored", nh, 20, 0, {"width": WIDE}),
        ("pulls", 9, 5, "one-sided", mm, 40, 30, {}),
        ("pulls", 7, 4, "crossed", nh, 20, 0, {"order": 2, "width": 0.4}),
        ("loads", 9, 5, "one-sided", mm, 30, 16, {}),
        ("loads both ends", 15, 5, "mirrored", nh, 16, 14, {}),
        ("loads cavity", 9, 5, "one-sided", mm, 16, 0, {"order": 2}),
        ("contact half-plane", 9, 5, "one-sided", mm, 20, 10, {}),
        ("contact disk", 15, 5, "mirrored", nh, 20, 10, {}),
        ("contact box", 9, 5, "crossed", mm, 16, 10, {}),
        ("contact disk", 7, 4, "one-sided", mm, 8, 0, {"order": 2}),
        ("supports", 9, 5, "mirrored", mm, 30, 16, {}),
        ("supports sliding", 15, 5, "one-sided", nh, 20, 14, {}),
        ("supports sliding", 7, 4, "crossed", mm, 10, 0, {"order": 2}),
        ("everything", 9, 5, "one-sided", mm, 20, 10, {}),
    ]
    found = [
        Group(nx, ny, diagonals, material, "inverse-square", dtype, count, kind, **more)
        for kind, nx, ny, diagonals, material, many, few, more in plan
        for dtype, count in (("float64", many), ("float32", few))
        if count
    ]
    return extreme_cases.groups() + found


def cases(group: Group, count: int) -> list[Any]:
    """Scenes of one group, the same in every run."""
    if group.kind not in KNOBS:
        return extreme_cases.cases(group, count)
    random = np.random.default_rng(seed(str(group)))
    knobs = KNOBS[group.kind] | BODY | UNIT(group.dtype)
    pick = lambda values: values[random.integers(len(values))]
    orders = {name: random.permutation(values) for name, values in knobs.items()}
    turns = itertools.chain.from_iterable(
        [(name, order[k % len(order)]) for name, order in orders.items()] for k in itertools.count()
    )
    single = [Push(**{name: float(value)}) for name, value in itertools.islice(turns, (count + 1) // 2)]
    # The body and the units of a case are those of the reference in half of them: else few would have a solution.
    plain = [name for name in knobs if name not in KNOBS[group.kind]]
    joint = [{name: pick(values) for name, values in knobs.items()} for _ in range(count // 2)]
    kept = [{n: v for n, v in knobs.items() if k % 2 or n not in plain} for k, knobs in enumerate(joint)]
    return single + [Push(**each) for each in kept]


def build(group: Group, case: Any, dtype: str) -> tuple[jb.Scene, Problem, np.ndarray]:
    """The scene, the raw arrays that the verification starts from, and the commands."""
    if group.kind not in KNOBS:
        scene, raw = extreme_cases.build(group, case, dtype)
        return scene, raw, case.ratios(sum(len(t.lines) for t in raw.tendons))
    mesh, high = _mesh(group, case, dtype)
    plain = np.asarray(mesh.nodes, np.float64)
    fixed = np.repeat(plain[:, :1] < -0.4999 * LENGTH, 2, axis=1)
    if group.kind == "loads both ends":
        fixed[high] = True
    shift = case.offset * np.array([1.0, 0.5])
    nodes = (case.length * (plain + shift)).astype(dtype) if (case.length, case.offset) != (1, 0) else plain
    tendons, actions, commands = _actions(group, case, plain, shift)
    raw = Problem(
        np.asarray(nodes, dtype),
        mesh.elements,
        fixed,
        case.stress * YOUNG,
        case.poisson,
        group.material,
        tendons,
        actions=actions,
    )
    return scene_of(raw, high), raw, np.array(commands)


def _mesh(group: Group, case: Push, dtype: str) -> tuple[jb.Mesh, np.ndarray]:
    """The body, and the nodes of its end."""
    mesh = jb.rectangle(LENGTH, case.height(group), group.nx, group.ny, group.diagonals, dtype, order=group.order)
    if group.kind == "loads cavity":
        corners = jb.rectangle(LENGTH, case.height(group), group.nx, group.ny, group.diagonals, dtype)
        middles = np.asarray(corners.nodes)[corners.elements].mean(axis=1)
        within = np.array([LENGTH / (group.nx - 1), case.height(group) / (group.ny - 1)])
        kept = np.asarray(corners.elements)[~(np.abs(middles) < within).all(axis=1)]
        used, numbers = np.unique(kept, return_inverse=True)
        mesh = jb.quadratic(jb.Mesh(np.asarray(corners.nodes)[used], numbers.reshape(kept.shape)))
    return mesh, np.flatnonzero(np.asarray(mesh.nodes)[:, 0] > 0.4999 * LENGTH)


def _actions(
    group: Group, case: Push, plain: np.ndarray, shift: np.ndarray
) -> tuple[tuple[Tendons, ...], tuple[Action, ...], list[float]]:
    """Tendons, what else acts on the body with nodes `plain` at the origin, and the commands of both."""
    kind, unit, height = group.kind.split()[0], case.length, case.height(group)
    ny, middle = group.ny, middle_column(group.nx, False) * group.ny
    lines = np.array([[ny - 1, middle + ny - 1], [0, middle]])
    widths = unit * np.array([[0.0, group.width]] * 2)
    modulus = case.factor * MODULUS * case.stress * unit**2
    pair, ratios = (Tendons(lines, modulus, group.law, widths),), [case.top, case.bottom]
    if kind == "cables":
        return (), (Cables(lines, modulus, group.law, widths, transition=case.transition),), ratios
    tension = case.tension * case.stress * YOUNG * height * unit
    if kind == "pulls":
        # Beside them is a tendon, which is commanded by its length.
        apart = lines if group.width else lines + np.array([[0], [1]])
        one, second = (Tendons(lines[1:], modulus, group.law, widths[1:]),), case.second * case.stress * YOUNG * height
        return one, (Pulls(apart, widths),), [case.top, tension, second * unit]
    x, y = plain.T
    at = {"top": y > 0.4999 * height, "bottom": y < -0.4999 * height, "tip": x > 0.4999 * LENGTH}
    on = lambda *names: np.flatnonzero(np.any([at[name] for name in names], axis=0))
    way = case.stress * YOUNG * np.array([np.cos(np.deg2rad(case.turn)), np.sin(np.deg2rad(case.turn))])
    weight = Weight(case.weight / (LENGTH * unit) * way)
    if kind == "loads":
        pulled = on("top" if group.kind == "loads both ends" else "tip")
        within = 1.01 * np.array([LENGTH / (group.nx - 1), height / (group.ny - 1)])
        pressed = {
            "loads": on("top", "bottom", "tip"),
            "loads both ends": on("bottom"),
            "loads cavity": np.flatnonzero((np.abs(plain) < within).all(axis=1)),
        }[group.kind]
        actions = (weight, Traction(pulled, case.traction * way), Pressure(pressed))
        return (), actions, [case.pressure * case.stress * YOUNG]
    if kind != "supports":
        touching, pushed = _contact(group, case, on("bottom", "tip"), shift), case.pushed * height * unit
    if kind == "contact":
        return pair, (touching,), [*ratios, pushed]
    nodes, stretch, shear = on("tip"), (case.stretch - 1) * LENGTH * unit, case.shear * LENGTH * unit
    along = Support(nodes, np.tile([1.0, np.nan], (len(nodes), 1)))
    if kind == "everything":
        actions = (Pulls(lines[:1], widths[:1]), weight, touching, along)
        return pair, actions, [*ratios, tension, pushed, stretch]
    if group.kind == "supports":
        across = Support(nodes, np.tile([np.nan, 1.0], (len(nodes), 1)))
        return (), (along, across), [stretch, shear]
    # The end slides, and one node in the middle of the lower side is moved both ways.
    return pair, (along, Support(np.array([middle]), np.array([[0.5, 0.1]]))), [*ratios, stretch, shear]


def _contact(group: Group, case: Push, nodes: np.ndarray, shift: np.ndarray) -> Contact:
    """An obstacle a little below the beam, at three quarters of its length."""
    unit, low = case.length, -0.5 * case.height(group) - 0.05
    # No thinner than an edge of the beam's end.
    size = max(case.size, 0.3 * case.height(group))
    shape = group.kind.split()[1] if " " in group.kind else "disk"
    depth, more = {
        "half-plane": (0.0, np.array([0.0, 1.0])),
        "disk": (size, np.array(size * unit)),
        "box": (0.7 * size, np.array([1.6 * size * unit, 1.2 * size * unit, 5.0])),
    }[shape]
    place = unit * (np.array([0.25 * LENGTH, low - depth]) + shift)
    stiffness, way = case.stiffness / LENGTH * case.stress / unit, np.deg2rad(case.toward)
    transition = case.transition * LENGTH * unit
    return Contact(nodes, shape, place, more, stiffness, transition, (np.cos(way), np.sin(way)))
