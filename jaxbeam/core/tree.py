"""Frozen dataclasses as pytrees: floats are leaves, index arrays are structure.

A field is one of three kinds:

- data (the default): a leaf or a subtree that JAX traces and differentiates;
- `index_field()`: an integer or boolean array. While it is a NumPy array it belongs to the *structure* of the tree and
  is compared by content. So `jax.grad` and `jax.vmap` of a scene see only floats, and scenes on one mesh stack without
  copies of its topology. `unlock` turns index arrays into leaves. The solver does this at its own jit boundary, where
  a new topology of the same shape must not compile again;
- `static_field()`: a hashable value, such as a function.

`jax.tree_util.register_dataclass` rebuilds objects through their constructor, which then receives tracers and
placeholders. Here unflattening bypasses the constructor, so a constructor can validate what a person passes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeAlias, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike

T = TypeVar("T")

# What users may pass for an array: JAX or NumPy arrays, numbers, or (nested) lists of numbers.
Numbers: TypeAlias = ArrayLike | Sequence[Any]


def index_field(**kwargs: Any) -> Any:
    """A dataclass field for an index array (structure while it is a NumPy array)."""
    return dataclasses.field(metadata={"kind": "index"}, **kwargs)


def static_field(**kwargs: Any) -> Any:
    """A dataclass field for a hashable value that selects what is traced."""
    return dataclasses.field(metadata={"kind": "static"}, **kwargs)


class Key:
    """A NumPy array hashed and compared by content."""

    __slots__ = ("_device", "_hash", "array")

    def __init__(self, array: np.ndarray) -> None:
        self.array = array
        self._hash = hash((array.shape, array.dtype.str, array.tobytes()))
        self._device: jax.Array | None = None

    def on_device(self) -> Any:
        """The array as a JAX array, made once and kept."""
        if self._device is not None:
            return self._device
        array = to_device(self.array)
        if isinstance(array, jax.Array):
            self._device = array
        return array

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        return (
            isinstance(other, Key)
            and self._hash == other._hash
            and self.array.dtype == other.array.dtype
            and np.array_equal(self.array, other.array)
        )


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(index_field, static_field))
def pytree(cls: type[T]) -> type[T]:
    """Decorator: make a class a frozen dataclass and a pytree node, by the rules at the head of this module."""
    dataclasses.dataclass(frozen=True, eq=False)(cls)
    names: dict[str, list[str]] = {"data": [], "index": [], "static": []}
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]
        names[field.metadata.get("kind", "data")].append(field.name)

    def flatten(self: Any) -> tuple[list[Any], Any]:
        children = [getattr(self, name) for name in names["data"]]
        keys: list[Key | None] = []
        for name in names["index"]:
            value = getattr(self, name)
            # Tangents of whole numbers (dtype `float0`, kind V) are NumPy arrays too, but they are leaves.
            if isinstance(value, np.ndarray) and value.dtype.kind != "V":
                keys.append(key_of(self, name))
            else:
                keys.append(None)
                children.append(value)
        return children, (tuple(keys), tuple(getattr(self, name) for name in names["static"]))

    def flatten_with_keys(self: Any) -> tuple[list[tuple[Any, Any]], Any]:
        children, aux = flatten(self)
        named = names["data"] + [name for name, key in zip(names["index"], aux[0], strict=True) if key is None]
        return [(jax.tree_util.GetAttrKey(name), child) for name, child in zip(named, children, strict=True)], aux

    def unflatten(aux: Any, children: Any) -> Any:
        keys, statics = aux
        self = object.__new__(cls)
        values = iter(children)
        for name in names["data"]:
            object.__setattr__(self, name, next(values))
        for name, key in zip(names["index"], keys, strict=True):
            object.__setattr__(self, name, next(values) if key is None else key.array)
            if key is not None:
                _keys(self)[name] = key
        for name, value in zip(names["static"], statics, strict=True):
            object.__setattr__(self, name, value)
        return self

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls


def key_of(owner: Any, name: str) -> Key:
    """The key of an index array. It is hashed once and kept, because a scene is commanded and solved many times."""
    keys, array = _keys(owner), getattr(owner, name)
    if name not in keys or keys[name].array is not array:
        keys[name] = Key(array)
    return keys[name]


def _keys(owner: Any) -> dict[str, Key]:
    """Keys of an owner's index arrays that were made so far. `replace` shares this dictionary with its copies."""
    return owner.__dict__.setdefault("_keys", {})


def unlock(tree: T) -> T:
    """The same tree with its index arrays as leaves, so that a jitted function is traced once per shape."""
    if isinstance(tree, tuple | list):
        items = [unlock(item) for item in tree]
        return type(tree)(*items) if hasattr(tree, "_fields") else type(tree)(items)
    if not dataclasses.is_dataclass(tree):
        return tree
    new = object.__new__(type(tree))
    for field in dataclasses.fields(tree):
        value = getattr(tree, field.name)
        if isinstance(value, np.ndarray) and field.metadata.get("kind") == "index":
            value = key_of(tree, field.name).on_device()
        elif "kind" not in field.metadata:
            value = unlock(value)
        object.__setattr__(new, field.name, value)
    return new


def replace(tree: T, **changes: Any) -> T:
    """A copy with some data fields changed: like `dataclasses.replace`, but nothing is validated again."""
    new = object.__new__(type(tree))
    _keys(tree)
    new.__dict__.update(tree.__dict__ | changes)
    return new


def why_unknown(tree: Any, *others: Any) -> str:
    """Why the numbers of a tree cannot be told, in words; empty if they can. For `repr`, which must always work.

    JAX builds trees of the same structure with any values as leaves. `others` are fields that could also be `None`.
    """
    leaves = [*jax.tree.leaves(tree), *others]
    if not all(isinstance(leaf, jax.Array | np.ndarray) and _is_number(leaf.dtype) for leaf in leaves):
        return "a tree of other values"
    if not is_concrete(*leaves):
        return "traced"
    on_device = [leaf for leaf in leaves if isinstance(leaf, jax.Array)]
    if any(leaf.is_deleted() for leaf in on_device):
        return "deleted"
    return "" if all(leaf.is_fully_addressable for leaf in on_device) else "spread over processes"


def _is_number(dtype: Any) -> bool:
    """Whether it is a dtype of numbers or booleans; tangents of whole numbers have another one."""
    return isinstance(dtype, np.dtype) and dtype.kind in "biufc"


def numbers_in_words(values: Any, most: int = 8) -> str:
    """Numbers `(m,)` to six digits, such as `[0.4, 1]`; of more than `most` the first ones and the count."""
    row = np.ravel(values)
    shown = ", ".join(f"{value:.6g}" for value in row[:most])
    return f"[{shown}]" if row.size <= most else f"[{shown}, ... {row.size} in all]"


def is_concrete(*values: Any) -> bool:
    """Whether no value is a tracer, so that checks on numbers can run on the host."""
    return not any(isinstance(value, Tracer) for value in values)


def namespace(*values: Any) -> Any:
    """NumPy if no value is a tracer, else `jax.numpy`. So a scene of plain numbers is built without compiling."""
    return np if is_concrete(*values) else jnp


def spread(values: Any, like: Any) -> Any:
    """`values` in the dtype and the shape of `like`: one command for all stencils of a term."""
    xp = namespace(values)
    return xp.broadcast_to(xp.asarray(values, like.dtype), like.shape)


def to_device(values: Any, dtype: Any = None) -> Any:
    """Plain numbers or a JAX array as a JAX array of `dtype`, by default of JAX's own dtype for them.

    `jnp.asarray` would compile a program for each shape it meets.
    """
    if isinstance(values, jax.Array):
        return values if dtype in (None, values.dtype) else values.astype(dtype)
    # Inside jit, too, the result is a concrete array, on which checks can run.
    host = np.asarray(values, dtype)
    with jax.ensure_compile_time_eval():
        array = jax.device_put(host)
    # In shard_map outside jit the result is traced even so. A tracer must not be kept for later calls: return NumPy.
    return array if is_concrete(array) else host


def read_only(values: Any, dtype: Any = None) -> np.ndarray:
    """A read-only NumPy copy, for an index field."""
    array = np.array(values, dtype=dtype)
    array.setflags(write=False)
    return array
