"""Trees of records as JSON and a list of arrays, and back.

A tree is made of dataclasses (scenes, terms, energies, solutions, parameters), tuples, named tuples, lists,
dictionaries, numbers, texts, functions by their names, and arrays. In JSON an array is its number in the list. Nothing
is computed on the way, so that what comes back is the same to the last bit, dtypes and index arrays included.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from jaxbeam.core.tree import to_device
from jaxbeam.files.names import name_of, named

# Kinds of dtypes that a file of NumPy keeps as they are.
_KINDS = "fiubc"


# ------------------------------------------------------------------------------------------------ to JSON


def encode(value: Any, where: str, arrays: list[np.ndarray]) -> Any:
    """A tree as values of JSON. Its arrays are appended to `arrays`.

    Args:
        value: the tree.
        where: its name in messages.
        arrays: the list.

    Raises:
        ValueError: if it holds traced values, functions without a name, or anything else that cannot be stored.
    """
    if isinstance(value, Tracer):
        raise ValueError(f"{where}: expected concrete values, got a traced array; save outside jit, vmap and grad")
    if value is None or type(value) in (bool, int, str):
        return value
    if type(value) is float:
        return {"float": value.hex()}
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return _encode_array(value, where, arrays)
    if isinstance(value, tuple | list):
        items = [encode(item, f"{where}[{k}]", arrays) for k, item in enumerate(value)]
        if hasattr(value, "_fields"):
            return {"named tuple": name_of(type(value), where), "items": items}
        if type(value) in (tuple, list):
            return {type(value).__name__: items}
    if type(value) is dict:
        return {"dict": [[_key(k, where), encode(v, f"{where}[{k!r}]", arrays)] for k, v in value.items()]}
    if callable(value) and hasattr(value, "__qualname__"):
        return {"function": name_of(value, where)}
    return _encode_record(value, where, arrays)


def _encode_array(value: Any, where: str, arrays: list[np.ndarray]) -> Any:
    if value.dtype.kind not in _KINDS or not isinstance(value.dtype, np.dtype):
        raise ValueError(f"{where}: expected real numbers or booleans, got dtype {value.dtype}; convert it")
    if isinstance(value, jax.Array) and not value.is_fully_addressable:
        raise ValueError(f"{where}: expected an array of this process, got one spread over several; gather it first")
    kind = "device" if isinstance(value, jax.Array) else "scalar" if isinstance(value, np.generic) else "host"
    if kind == "host" and not value.flags.writeable:
        kind = "read-only"
    arrays.append(np.asarray(value))
    return {"array": len(arrays) - 1, "on": kind}


def _key(key: Any, where: str) -> Any:
    if type(key) not in (str, int, bool):
        raise ValueError(f"{where}: expected keys that are texts or whole numbers, got {key!r}; rename it")
    return key


def _encode_record(value: Any, where: str, arrays: list[np.ndarray]) -> Any:
    """A dataclass, or an object of a class without attributes, such as a plain `Energy`."""
    cls, names = type(value), _fields(type(value))
    if set(getattr(value, "__dict__", {})) - set(names) - {"_keys"} or cls.__module__ == "builtins":
        raise ValueError(
            f"{where}: expected a dataclass, tuple, list, dictionary, array, number or function, got a {cls.__name__}; "
            f"make it a frozen dataclass"
        )
    fields = {name: encode(getattr(value, name), f"{where}.{name}", arrays) for name in names}
    return {"record": name_of(cls, where), "fields": fields}


def _fields(cls: type) -> list[str]:
    return [field.name for field in dataclasses.fields(cls)] if dataclasses.is_dataclass(cls) else []


# ---------------------------------------------------------------------------------------------- from JSON


def decode(value: Any, arrays: Sequence[np.ndarray], trust: tuple[str, ...]) -> Any:
    """The tree of what `encode` made. Constructors are not called: nothing is checked or computed again.

    Raises:
        ValueError: if it needs a module that is not trusted, a class that has other fields now, or float64 where
            JAX has it switched off.
    """
    if not isinstance(value, dict):
        return value
    inner = lambda items: [decode(item, arrays, trust) for item in items]
    if "float" in value:
        return float.fromhex(value["float"])
    if "array" in value:
        return _decode_array(arrays[value["array"]], value["on"])
    if "function" in value:
        return named(value["function"], trust)
    if "named tuple" in value:
        return named(value["named tuple"], trust)._make(inner(value["items"]))
    if "dict" in value:
        return {key: decode(item, arrays, trust) for key, item in value["dict"]}
    if "record" in value:
        return _decode_record(value, arrays, trust)
    return tuple(inner(value["tuple"])) if "tuple" in value else inner(value["list"])


def _decode_array(array: np.ndarray, kind: str) -> Any:
    if kind == "device":
        if jax.dtypes.canonicalize_dtype(array.dtype) != array.dtype:
            raise ValueError(
                f"path: the archive holds {array.dtype}, which JAX keeps only while jax_enable_x64 is on; set "
                f'jax.config.update("jax_enable_x64", True) before loading'
            )
        return to_device(array)
    if kind == "scalar":
        return array[()]
    if kind == "read-only":
        array.setflags(write=False)
    return array


def _decode_record(value: dict[str, Any], arrays: Sequence[np.ndarray], trust: tuple[str, ...]) -> Any:
    cls, fields = named(value["record"], trust), value["fields"]
    if not isinstance(cls, type) or set(_fields(cls)) != set(fields):
        raise ValueError(
            f"path: the archive holds a {value['record']} with the fields {', '.join(fields) or 'none'}, which has "
            f"others now; use the version that wrote it"
        )
    record: Any = object.__new__(cls)
    for name, content in fields.items():
        object.__setattr__(record, name, decode(content, arrays, trust))
    return record
