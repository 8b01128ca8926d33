"""The picture of one state of a beam, which can be moved to other states."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxbeam.core.tree import Numbers
from jaxbeam.plot.acting import Acted, Acting
from jaxbeam.plot.drawing import (
    Body,
    Limits,
    add_legend,
    doing_of,
    fit_height,
    limits,
    panels,
    positions_of,
    prepare,
)
from jaxbeam.plot.fields import Field, Function, Scale, check_values, field_of, scales_of
from jaxbeam.plot.lines import extremes
from jaxbeam.plot.loads import Outside
from jaxbeam.scene.scene import Scene, command


class Panel:
    """The artists of a beam and of what acts on it, on axes whose limits are set."""

    def __init__(self, ax: Axes, acting: Acting, scale: Scale | None = None) -> None:
        self.ax, self.body, self.outside = ax, Body(ax, acting.scene, scale), Outside(ax, acting)

    def show(self, state: Acted, doing: np.ndarray, values: np.ndarray | None = None) -> None:
        """Draw a state: what its tendons do `(m,)`, and the values of the field, if any."""
        self.body.move(state.x, doing, values)
        self.outside.move(state)

    def add_colour_bar(self, label: str, scale: Scale) -> None:
        """A colour bar beside the axes. It is as high as they are, whatever their aspect."""
        bar = self.ax.inset_axes((1.03, 0.0, 0.035, 1.0))
        self.ax.figure.colorbar(self.body.coloured, cax=bar, label=label, extend=scale.extend)


def add_colour_bar(figure: Figure, axes: Sequence[Axes], panels: Sequence[Panel], label: str, scale: Scale) -> None:
    """One colour bar for all `panels`, below `axes`: beside flat ones there is no room for its label."""
    look: dict[str, Any] = {"location": "bottom", "shrink": 0.7, "aspect": 40, "pad": 0.05, "extend": scale.extend}
    figure.colorbar(panels[0].body.coloured, ax=list(axes), label=label, **look)


class Picture:
    """A beam drawn at `x`. `move` draws it in another state, in a few milliseconds.

    It shows the mesh, tendons, guides and anchors, the clamp, what acts on the body, the outline at rest, and a field
    in colour if one is given. For an animation of your own make one picture and move it in each frame:

        picture = plot.Picture(scene, path.x[0], bounds=plot.limits(path.x))
        FuncAnimation(picture.ax.figure, lambda k: picture.move(path.x[k], path.ratios[k]), frames=len(path.x))

    Args:
        scene: under the commands of this state, which decide which tendons push and where obstacles are.
        x: `(n, d)` node positions; by default those at rest.
        field: what to show in colour: a `Field`, or a function `(scene, x)`. Its colour scale is that of this state;
            `Field(colours=...)` sets another one.
        ax: where to draw (`ax.legend()` names what is there); by default a new figure with a legend.
        bounds: axis limits, by default those that hold the beam here and at rest, and what acts on it.

    The attribute `ax` holds the axes, and `values` those of the field that are drawn, or None.

    Raises:
        ValueError: if `x` or the values of the field have another shape or are not finite.
    """

    def __init__(
        self,
        scene: Scene,
        x: Numbers | None = None,
        *,
        field: Field | Function | None = None,
        ax: Axes | None = None,
        bounds: Limits | None = None,
    ) -> None:
        field = field_of(field)
        positions = positions_of(scene, scene.mesh.nodes if x is None else x)
        acting = Acting(scene)
        state = acting.see(scene, positions)
        bounds = bounds or limits(*extremes(scene, positions[None]), *acting.extremes([state]))
        figure, axes = (None, [prepare(ax, bounds)]) if ax else panels(1, [bounds])
        self.scene, self.ax, self.field, self._acting = scene, axes[0], field, acting
        self._measure = field.compiled if field and callable(field.values) else None
        self.values = self._values(state, field.values if field and not self._measure else None)
        (scale,) = scales_of(field, [(scene, self.values[None])]) if field and self.values is not None else (None,)
        self._panel = Panel(axes[0], acting, scale)
        doing = np.asarray(doing_of(scene, jnp.asarray(positions)))
        self._panel.show(state, doing, self.values)
        if field and scale:
            self._panel.add_colour_bar(field.label, scale)
            self.field = dataclasses.replace(field, at_nodes=scale.at_nodes)  # it cannot show values of the other place
        if figure:
            add_legend(figure, [acting], [doing])
            fit_height(figure, axes)

    def move(
        self,
        x: Numbers,
        commands: Numbers | None = None,
        *,
        values: Numbers | None = None,
        trusted: bool = True,
    ) -> Sequence[Artist]:
        """Draw the beam at `x` `(n, d)` under `commands` `(m,)`, by default those that it was made with.

        Args:
            x: node positions.
            commands: ratios of tendons, pressures and others.
            values: of the field in this state, if it is not one of a function.
            trusted: if not, the outline is red and dashed: for a state whose status is not `OK`.

        Returns:
            The artists that moved, which `FuncAnimation(..., blit=True)` asks for.

        Raises:
            ValueError: as the class does, and if `values` are needed and missing, or given and not needed.
        """
        scene = self.scene if commands is None else command(self.scene, commands)
        state = self._acting.see(scene, positions_of(scene, x))
        self.values = self._values(state, values)
        if self.field and self.values is not None:
            check_values(self.field, scene, self.values[None])
        self._panel.show(state, np.asarray(doing_of(scene, jnp.asarray(state.x))), self.values)
        self._panel.body.mark(trusted)
        return self.artists

    @property
    def artists(self) -> list[Artist]:
        """The artists that `move` moves, from the lowest to the highest."""
        found = [*self._panel.body.artists, *self._panel.outside.artists]
        return sorted(found, key=lambda artist: artist.get_zorder())

    def _values(self, state: Acted, given: object) -> np.ndarray | None:
        """The values of the field in a state."""
        if self.field is None or self._measure:
            if given is not None:
                raise ValueError("values: expected none, because the picture has no field, or one of a function")
            return np.asarray(self._measure(state.scene, jnp.asarray(state.x))) if self._measure else None
        if given is None:
            raise ValueError(
                "values: expected those of the field in this state, got none; give them, or make the picture with a "
                "Field of a function (scene, x)"
            )
        return np.asarray(given)


def beam(scene: Scene, x: Numbers, *, ax: Axes | None = None, bounds: Limits | None = None) -> Axes:
    """The axes of `Picture(scene, x)`: the beam with its mesh, tendons, clamp and what acts on it."""
    return Picture(scene, x, ax=ax, bounds=bounds).ax


def field(
    scene: Scene,
    x: Numbers,
    values: Numbers | Function,
    label: str,
    *,
    centre: float | None = None,
    colours: tuple[float, float] | None = None,
    ax: Axes | None = None,
    bounds: Limits | None = None,
) -> Axes:
    """The axes of `Picture(scene, x, field=Field(values, label, centre, colours))`: a field in colour."""
    return Picture(scene, x, field=Field(values, label, centre, colours), ax=ax, bounds=bounds).ax
