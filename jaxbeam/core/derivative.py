"""Functions with a derivative rule of their own, to any order and under every transformation.

The rule of an implicit function calls that function again, to be differentiated again. With `jax.custom_jvp` such
second derivatives are silently wrong in reverse mode under `lax.map`, `lax.scan` or `jax.checkpoint`: JAX replaces the
inner call by its operations, and then differentiates these instead of asking for the rule. A primitive of JAX keeps its
rule, so each function here becomes a primitive of its own.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jaxbeam.core.compiling import usual_rules

T = TypeVar("T")

# Levels of `jax.vmap`, innermost first: the mapped axis of each leaf, `None` for a leaf that is not mapped.
Axes = tuple[tuple[int | None, ...], ...]


class custom_derivative(Generic[T]):
    """Decorator: a function of pytrees of arrays with the derivative rule set by `defjvp`, as in `jax.custom_jvp`.

    Args:
        function: takes `static` hashable arguments first, then pytrees of arrays.
        static: number of leading arguments that are hashable values instead of arrays.
    """

    def __init__(self, function: Callable[..., T], static: int = 0) -> None:
        functools.update_wrapper(self, function)
        # Jitted, so that each shape is traced once, and not again by each transformation.
        self.function, self.static = jax.jit(function, static_argnums=tuple(range(static))), static
        self._values = functools.lru_cache(maxsize=256)(self._values_of)
        self.rule: Callable[..., tuple[T, T]] | None = None
        self.primitive = Primitive(function.__name__.strip("_"))
        self.primitive.multiple_results = True
        self.primitive.def_impl(lambda *leaves, **parameters: self._values(**parameters)(*leaves))
        self.primitive.def_abstract_eval(self._shapes)
        mlir.register_lowering(
            self.primitive,
            mlir.lower_fun(lambda *leaves, **parameters: self._values(**parameters)(*leaves), multiple_results=True),
        )
        ad.primitive_jvps[self.primitive] = self._differentiated
        batching.primitive_batchers[self.primitive] = self._batched

    def defjvp(self, rule: Callable[..., tuple[T, T]]) -> Callable[..., tuple[T, T]]:
        """Set the rule `(*static, primals, tangents) -> (value, tangent of the value)`.

        `primals` and `tangents` are tuples with an entry for each array argument. Tangents of whole numbers and
        booleans are of dtype `float0`.
        """
        self.rule = rule
        return rule

    def __call__(self, *arguments: Any) -> T:
        static, arrays = arguments[: self.static], arguments[self.static :]
        leaves, tree = jax.tree.flatten(arrays)
        shape = jax.tree.structure(jax.eval_shape(functools.partial(self.function, *static), *arrays))
        found = self.primitive.bind(*(jnp.asarray(leaf) for leaf in leaves), static=static, tree=tree, axes=())
        return jax.tree.unflatten(shape, found)

    def _values_of(self, static: tuple[Any, ...], tree: Any, axes: Axes) -> Callable[..., list[jax.Array]]:
        """The function as a jitted one from leaves to leaves, mapped over each level of `axes`."""

        @usual_rules
        def flat(*leaves: jax.Array) -> list[jax.Array]:
            return jax.tree.leaves(self.function(*static, *jax.tree.unflatten(tree, leaves)))

        return jax.jit(_mapped(flat, axes))

    def _shapes(self, *avals: Any, **parameters: Any) -> list[Any]:
        return jax.make_jaxpr(self._values(**parameters))(*avals).out_avals

    def _differentiated(
        self, primals: Sequence[Any], tangents: Sequence[Any], static: tuple[Any, ...], tree: Any, axes: Axes
    ) -> tuple[list[Any], list[Any]]:
        """The rule, as JAX asks a primitive for it: values and tangents of the result, leaf by leaf.

        A tangent that JAX knows to be zero is no array (`ad.Zero`). `moving` are the leaves with another tangent. Under
        each level of `jax.vmap` a tangent is mapped along the same axis as its leaf.
        """
        if self.rule is None:
            raise TypeError(f"{self.primitive.name}: it has no derivative rule; set one with defjvp")
        rule, moving = self.rule, [k for k, tangent in enumerate(tangents) if not isinstance(tangent, ad.Zero)]
        count = len(primals)

        @usual_rules
        def value_and_change(*leaves: jax.Array) -> list[jax.Array]:
            values, changes = leaves[:count], [_zero_tangent(leaf) for leaf in leaves[:count]]
            for k, tangent in zip(moving, leaves[count:], strict=True):
                changes[k] = tangent
            unflatten = functools.partial(jax.tree.unflatten, tree)
            value, change = rule(*static, unflatten(values), unflatten(changes))
            return [*jax.tree.leaves(value), *jax.tree.leaves(change)]

        along = tuple((*level, *(level[k] for k in moving)) for level in axes)
        found = _mapped(value_and_change, along)(*primals, *(tangents[k] for k in moving))
        half = len(found) // 2  # a value and its change have the same leaves
        return found[:half], found[half:]

    def _batched(
        self, leaves: Sequence[Any], dims: Sequence[Any], static: tuple[Any, ...], tree: Any, axes: Axes
    ) -> tuple[list[Any], list[int]]:
        level = tuple(dim if isinstance(dim, int) else None for dim in dims)
        found = self.primitive.bind(*leaves, static=static, tree=tree, axes=(*axes, level))
        return found, [0] * len(found)


def _mapped(function: Callable[..., T], axes: Axes) -> Callable[..., T]:
    """A function of leaves, mapped by `jax.vmap` once for each level of `axes`, the first level innermost."""
    for level in axes:
        function = jax.vmap(function, in_axes=level)
    return function


def _zero_tangent(leaf: Any) -> Any:
    """The zero tangent of a leaf."""
    # A constant inside a traced function may come as a Python number.
    leaf = jnp.asarray(leaf)
    floating = jnp.issubdtype(leaf.dtype, jnp.inexact)
    return jnp.zeros_like(leaf) if floating else np.zeros(leaf.shape, jax.dtypes.float0)
