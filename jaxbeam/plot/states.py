"""States of one scene under several commands: what curves and animations are drawn from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.core import checks
from jaxbeam.core.tree import Numbers
from jaxbeam.plot.fields import Field
from jaxbeam.scene.scene import Scene, command, command_count, commanded_terms
from jaxbeam.solve.solution import Solution


class States:
    """States of one scene under `s` commands: a ramp, or a sweep.

    Args:
        scene: with `n` nodes and `m` commands.
        commands: `(s, m)`, such as ratios of tendons; or the `Solution` of a ramp or a sweep, which holds them and `x`.
        x: `(s, n, d)` node positions.
        title: their name in pictures.

    Raises:
        ValueError: if a shape is wrong, there is no state, or a position is not finite.
    """

    def __init__(self, scene: Scene, commands: Numbers | Solution, x: Numbers | None = None, title: str = "") -> None:
        if isinstance(commands, Solution):
            x, commands = commands.x, commands.ratios
        if x is None:
            raise ValueError("x: expected the positions of each state; give them, or a Solution in place of commands")
        checks.instance("scene", scene, Scene, "the states are those of a scene")
        count = command_count(scene)
        self.scene, self.commands, self.x, self.title = scene, np.asarray(commands), np.asarray(x), title
        if self.commands.ndim != 2 or self.commands.shape[0] == 0 or self.commands.shape[1] != count:
            raise ValueError(f"commands: expected shape (s, {count}), a row for each state, got {self.commands.shape}")
        expected = (len(self.commands), *scene.mesh.nodes.shape)
        if self.x.shape != expected:
            raise ValueError(f"x: expected shape {expected}, one entry for each command, got {self.x.shape}")
        broken = np.flatnonzero(~np.isfinite(self.x).all(axis=(1, 2)))
        if broken.size:
            raise ValueError(f"x: state {broken[0]} is not finite and cannot be drawn; see check(solution)")

    def __len__(self) -> int:
        return len(self.x)

    def measure(self, function: Callable[[Scene, jax.Array], jax.Array]) -> np.ndarray:
        """`function(scene, x)` of every state, such as `tip_angle` or `tendon_tensions`: leading axis `s`."""
        one = lambda ratios, x: function(command(self.scene, ratios), x)
        return np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(self.commands), jnp.asarray(self.x)))

    def values(self, field: Field | None) -> Any:
        """Values of a field in every state, `(s, n)` or `(s, t)`; None for each state if there is no field."""
        return [None] * len(self) if field is None else self.measure(field.function())

    @property
    def varied(self) -> int:
        """Number of the command that varies most; the first one if several vary alike."""
        return int(np.argmax(np.ptp(self.commands, axis=0).round(6)))

    @property
    def actuation(self) -> np.ndarray:
        """`(s,)` the command that varies most, such as the ratio of a tendon."""
        return self.commands[:, self.varied]

    @property
    def by_ratio(self) -> bool:
        """Whether that command is a ratio."""
        each = [term.kind.command_unit == 1 for term in commanded_terms(self.scene) for _ in range(term.command_count)]
        return each[self.varied]
