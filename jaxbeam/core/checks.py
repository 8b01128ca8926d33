"""Checks of what a person passes to a public function: each names the argument, what was expected, what came, the cure.

Numbers that are known are checked on the host. Of traced ones only the shape and the dtype are known; where a value
turns out to lie outside its range it becomes NaN, which spreads to the parameters made of it, and a scene with such a
parameter is solved with the status `INVALID`. So what is refused when it is concrete is `INVALID` when it is traced.
Derivatives by values in their range pass through; by others they are NaN.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxbeam.core.tree import is_concrete, read_only, to_device

T = TypeVar("T")


class Range(NamedTuple):
    """The numbers from `low`, which belongs to them if it is `closed`, up to `high`, which does not.

    one, many: what to call one of them, and several.
    """

    one: str
    many: str
    low: float = -np.inf
    high: float = np.inf
    closed: bool = False

    def holds(self, values: Any) -> Any:
        """Which values lie in the range; NaN does not."""
        return ((values >= self.low) if self.closed else (values > self.low)) & (values < self.high)


FINITE = Range("a finite number", "finite numbers")


POSITIVE = Range("a positive finite number", "positive finite numbers", low=0)


NOT_NEGATIVE = Range("a finite number of at least 0", "finite numbers of at least 0", low=0, closed=True)


SHARE = Range("a number between 0 and 1", "numbers between 0 and 1", low=0, high=1)


Shape = tuple[int, ...]


# Arrays of no more entries are shown whole.
SMALL = 8


# ------------------------------------------------------------------------------------------- real numbers


def numbers(
    name: str,
    value: Any,
    within: Range = FINITE,
    shapes: tuple[Shape, ...] | None = None,
    each: str = "",
    why: str = "",
) -> Any:
    """Real numbers within a range: a NumPy array, or a traced one in which NaN stands for what lies outside.

    Args:
        name: of the argument.
        value: what was passed for it.
        within: the range.
        shapes: those that it may have; any by default.
        each: what there is an entry for, such as "one for each tendon".
        why: the reason for the range, or the cure.

    Raises:
        ValueError: that names the argument.
    """
    return inside(name, shaped(name, value, shapes, each), within, within.many, why)


def number(name: str, value: Any, within: Range = FINITE, why: str = "") -> Any:
    """One real number within a range; otherwise as `numbers`."""
    array = real(name, value, "a real number")
    if array.ndim:
        raise ValueError(f"{name}: expected {within.one}, got {_shown(value)}")
    return inside(name, array, within, within.one, why)


def setting(name: str, value: Any, within: Range = FINITE, why: str = "") -> float:
    """One real number that must be known, because the host or the compiler needs its value."""
    if not is_concrete(value):
        raise ValueError(f"{name}: expected {within.one}, got a traced value; give a Python number")
    return float(number(name, value, within, why))


def inside(name: str, array: Any, within: Range, words: str = "", why: str = "") -> Any:
    """Real numbers as `real` returns them, within a range."""
    if isinstance(array, Tracer):
        floats = array if array.dtype.kind == "f" else array.astype(jnp.result_type(float))
        return poisoned(floats, within.holds(floats))
    good = within.holds(array)
    if not good.all():
        k = tuple(map(int, np.unravel_index(int(np.argmin(good)), array.shape)))
        got = array.tolist() if array.size <= SMALL else f"{array[k].item()} at entry {k[0] if len(k) == 1 else k}"
        reason = f"; {why}" if why else ""
        raise ValueError(f"{name}: expected {words or within.many}, got {got}{reason}")
    return array


def poisoned(values: jax.Array, good: jax.Array) -> jax.Array:
    """Traced values where they are good, elsewhere NaN, and so are their derivatives: zero would pass for an answer."""
    return values * jnp.where(good, 1.0, jnp.nan)


def shaped(name: str, value: Any, shapes: tuple[Shape, ...] | None, each: str = "") -> Any:
    """Real numbers of one of these shapes, in any range."""
    array = real(name, value)
    if shapes is not None and array.shape not in shapes:
        entries = [f"{shape[0]} entries" if len(shape) == 1 else f"shape {shape}" for shape in shapes[1:]]
        if shapes[0] == ():
            words, got = " or ".join(["a scalar", *entries]), f"shape {array.shape}"
        else:
            words, got = f"shape {' or '.join(map(str, shapes))}", f"{array.shape}"
        raise ValueError(f"{name}: expected {words}{', ' * bool(each)}{each}, got {got}")
    return array


def real(name: str, value: Any, expected: str = "real numbers") -> Any:
    """What was passed as a NumPy array of floats or whole numbers; traced values as a JAX array."""
    array = plain(name, value, expected)
    if array.dtype.kind not in "fiu" or (array.dtype.itemsize < 4 and array.dtype.kind == "f"):
        raise ValueError(f"{name}: expected {expected}, got {_shown(value, array)}; {_cure(array.dtype)}")
    return array


def plain(name: str, value: Any, expected: str) -> Any:
    """What was passed as an array of any dtype."""
    if isinstance(value, Tracer):
        return value
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError(f"{name}: expected {expected}, got a masked array; fill it with .filled(value)")
    if isinstance(value, list | tuple) and any(isinstance(entry, bool) for entry in value):
        raise ValueError(f"{name}: expected {expected}, got {_shown(value)}; convert booleans with float(...)")
    try:
        return np.asarray(value)
    except jax.errors.TracerArrayConversionError:
        return jnp.asarray(value)
    except (ValueError, TypeError):
        raise ValueError(
            f"{name}: expected {expected}, got {_shown(value)}; its rows must be numbers, and all of one length"
        ) from None


def _shown(value: Any, array: Any = None) -> str:
    """What came, in a few words."""
    if array is not None and array.ndim and array.dtype.kind != "O":
        return f"dtype {array.dtype}"
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _cure(dtype: Any) -> str:
    """What to do with numbers of a dtype that is refused."""
    if dtype.kind == "c":
        return "take the real part with .real"
    if dtype.kind == "f" or "float" in str(dtype):
        return "convert it to float32 or float64, float16 has too few digits"
    return "convert it with float(...) or .astype(float)"


# -------------------------------------------------------------------------------------- settings and names


def count(name: str, value: Any, least: int, most: int | None = None, why: str = "") -> int:
    """A whole number."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or value < least or (most is not None and value > most):
        span = f"of at least {least}" if most is None else f"from {least} to {most}"
        raise ValueError(f"{name}: expected a whole number {span}{', ' * bool(why)}{why}, got {_shown(value)}")
    return int(value)


def flag(name: str, value: Any) -> bool:
    """True or False, and not what merely counts as such, for that includes every text."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name}: expected True or False, got {_shown(value)}")
    return bool(value)


def function(name: str, value: Any, form: str) -> Any:
    """Something that can be called, as `form` says."""
    if not callable(value):
        raise ValueError(f"{name}: expected a function {form}, got {_shown(value)}")
    return value


def scalar(name: str, form: str, value: Any, *arguments: Any) -> None:
    """Refuse a function that does not return one real number for such arguments. It is traced, not run."""
    found = jax.eval_shape(value, *arguments)
    if getattr(found, "shape", None) != () or found.dtype.kind != "f":
        raise ValueError(f"{name}: expected a function {form} that returns one real number, got {found}")


def parameter(name: str, value: Any) -> Any:
    """A leaf of the parameters of a term: numbers, or booleans, that can be computed with."""
    array = value if isinstance(value, jax.Array | np.ndarray) else plain(name, value, "numbers")
    if isinstance(value, np.ma.MaskedArray) or array.dtype.kind not in "fiub" or array.dtype in (np.float16,):
        real(name, value)
    return array


def instance(name: str, value: T, kind: type, cure: str) -> T:
    """An object of a class."""
    if not isinstance(value, kind):
        got = f"the class {value.__name__} itself" if isinstance(value, type) else f"a {type(value).__name__}"
        raise ValueError(f"{name}: expected a {kind.__name__}, got {got}; {cure}")
    return value


def float_dtype(name: str, value: Any) -> Any:
    """A dtype to compute in: that of JAX's floats if none is given, else float32 or float64."""
    if value is None:
        return jnp.result_type(float)
    try:
        dtype = np.dtype(value)
    except TypeError:
        dtype = None
    if dtype not in (np.float32, np.float64):
        raise ValueError(f"{name}: expected float32 or float64, got {_shown(value)}")
    return dtype


# ------------------------------------------------------------------------------------- nodes and positions


def node_numbers(name: str, total: int, value: Any, ndim: int) -> np.ndarray:
    """Numbers of some of `total` nodes, in an array of `ndim` axes that is not empty."""
    if not is_concrete(value):
        raise ValueError(f"{name}: expected concrete node numbers, got a traced array")
    shape = "(m,)" if ndim == 1 else "(m, k)"
    cure = "" if ndim == 1 else "; rows of different lengths, as of tendons with more guides, are terms of their own"
    try:
        array = plain(name, value, f"whole numbers of shape {shape}")
    except ValueError as error:
        raise ValueError(f"{error}{cure}") from None
    if array.dtype.kind not in "iu" or array.ndim != ndim or array.size == 0:
        raise ValueError(f"{name}: expected whole numbers of shape {shape}, got shape {array.shape} of {array.dtype}")
    outside = array[(array < 0) | (array >= total)]
    if outside.size:
        raise ValueError(f"{name}: {outside[0]} is out of range, nodes are numbered 0 to {total - 1}")
    return array


def whole_numbers(name: str, value: Any, shape: str, columns: tuple[int, ...]) -> np.ndarray:
    """Rows of whole numbers, at least one, with one of these numbers of columns: an array fit to be structure."""
    if not is_concrete(value):
        raise ValueError(f"{name}: expected concrete node numbers, got a traced array; build the topology outside")
    array = plain(name, value, f"whole numbers of shape {shape}")
    if array.dtype.kind not in "iu":
        raise ValueError(f"{name}: expected whole numbers, got dtype {array.dtype}")
    if array.ndim != 2 or array.shape[1] not in columns or not len(array):
        raise ValueError(f"{name}: expected shape {shape} with {shape[1]} >= 1, got {array.shape}")
    if array.max() >= 2**31:
        raise ValueError(f"{name}: node numbers must fit 32 bits, got {array.max()}")
    return read_only(array, np.int32)


def positions(name: str, value: Any, shape: Shape, dtype: Any) -> jax.Array:
    """Positions of all nodes as a JAX array: one of floats as it is, other numbers as one of `dtype`."""
    expected = f"node positions of shape {shape}"
    if hasattr(value, "status") and hasattr(value, "x"):
        raise ValueError(f"{name}: expected {expected}, got a {type(value).__name__}; give its positions, solution.x")
    # Not brought to the host: it may not be computed yet.
    array = value if isinstance(value, jax.Array) else real(name, value, expected)
    if (array.dtype.kind != "f" and isinstance(value, jax.Array)) or array.dtype.itemsize < 4:
        raise ValueError(f"{name}: expected {expected}, got dtype {array.dtype}; {_cure(array.dtype)}")
    if array.shape != shape:
        many = array.ndim == len(shape) + 1 and array.shape[1:] == shape
        cure = f"; for many states use jax.vmap over {name}" if many else ""
        raise ValueError(f"{name}: expected {expected}, got {array.shape}{cure}")
    return array if isinstance(array, jax.Array) else to_device(array, dtype)
