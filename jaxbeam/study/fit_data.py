"""What `fit` is given, checked: parameters, bounds and data."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.tree_util import DictKey, GetAttrKey

from jaxbeam.core import checks
from jaxbeam.scene.scene import Scene, check_commands, command_count
from jaxbeam.study.expansion import Measure


def parameters_of(theta0: Any) -> tuple[np.ndarray, Callable[[jax.Array], Any], list[str]]:
    """Flat parameters `(q,)`, their way back, and their names."""
    leaves = jax.tree_util.tree_leaves_with_path(theta0)
    if not leaves:
        raise ValueError(f"theta0: expected a pytree of floats, got {theta0!r}")
    names = []
    for path, leaf in leaves:
        array = checks.numbers("theta0" + jax.tree_util.keystr(path), leaf)
        # {"young": [1.0, 2.0]} has young[0] and young[1]; a list alone theta[0] and theta[1].
        parts = [f".{key.key}" if isinstance(key, DictKey) else str(key) for key in path]
        word = "".join(parts).removeprefix(".")
        word = word if word and isinstance(path[0], DictKey | GetAttrKey) else "theta" + word
        names += [word] if array.ndim == 0 else [f"{word}{list(place)}" for place in np.ndindex(array.shape)]
    flat, unravel = ravel_pytree(jax.tree.map(lambda leaf: jnp.asarray(leaf, float), theta0))
    return np.asarray(flat, float), unravel, names


def bounds_of(
    bounds: tuple[Any, Any] | None, theta0: Any, start: np.ndarray, names: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest parameters `(q,)`."""
    if bounds is None:
        return np.full(len(start), -np.inf), np.full(len(start), np.inf)
    if not isinstance(bounds, tuple | list) or len(bounds) != 2:
        raise ValueError(f"bounds: expected (low, high), each as theta0 or one number, got {bounds!r}")
    ends = []
    for name, end in zip(("low", "high"), bounds, strict=True):
        try:
            whole = end if np.ndim(end) == 0 and not isinstance(end, dict) else None
            flat = np.full(len(start), whole, float) if whole is not None else np.asarray(ravel_pytree(end)[0], float)
        except (TypeError, ValueError):
            flat = np.zeros(0)
        same = whole is not None or str(jax.tree.structure(end)) == str(jax.tree.structure(theta0))
        if len(flat) != len(start) or not same:
            raise ValueError(f"bounds, {name}: expected the structure of theta0, or one number, got {end!r}")
        ends.append(flat)
    low, high = ends
    bad = np.flatnonzero(~((low <= start) & (start <= high)))
    if bad.size:
        k = bad[0]
        raise ValueError(
            f"bounds: expected low <= theta0 <= high, got {low[k]:g}, {start[k]:g}, {high[k]:g} of {names[k]}"
        )
    return low, high


def data_of(
    scene: Scene, commands: Any, values: Any, measure: Measure, sd: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Commands `(N, m)`, values `(N, p)` and standard deviations `(N, p)`, checked."""
    rows, data, m = checks.real("commands", commands), checks.real("values", values), command_count(scene)
    if rows.ndim != 2 or rows.shape[1] != m or not len(rows):
        raise ValueError(f"commands: expected shape (N, {m}), a row for each observation, got {rows.shape}")
    shape = jax.eval_shape(measure, scene, scene.mesh.nodes).shape
    if len(shape) > 1:
        raise ValueError(f"measure: expected a function (scene, x) to shape () or (p,), got shape {shape}")
    if data.shape != (len(rows), *shape):
        raise ValueError(
            f"values: expected shape {(len(rows), *shape)}, what the measure gives for each of the commands, got "
            f"{data.shape}"
        )
    data = data.reshape(len(rows), -1).astype(float)
    for name, array in (("commands", rows), ("values", data)):
        bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
        if bad.size:
            others = f", and {bad.size - 1} others are not" if bad.size > 1 else ""
            raise ValueError(
                f"{name}: observation {bad[0]} is not finite, {array[bad[0]].tolist()}{others}; leave such rows out, "
                f"or where one value of a row is missing, put 0 there and infinity in sd"
            )
    check_commands("commands", scene, rows)
    deviations = checks.real("sd", 1.0 if sd is None else sd)
    if deviations.shape not in {(), shape, (len(rows), *shape)}:
        raise ValueError(f"sd: expected shape (), {shape} or {(len(rows), *shape)}, got {deviations.shape}")
    deviations = np.broadcast_to(deviations, (len(rows), *shape)).reshape(data.shape)
    if not (deviations > 0).all():
        k, j = np.argwhere(~(deviations > 0))[0]
        raise ValueError(f"sd: expected positive numbers, got {deviations[k, j]} for observation {k}, component {j}")
    return rows.astype(float), data, deviations.astype(float)
