"""Checks of the arguments of public functions. An error names the argument, what was expected, what came and the cure.

Concrete numbers are checked on the host. Of traced numbers only the shape and the dtype are known. A traced value
outside its range becomes NaN. The NaN spreads to the parameters computed from it, and a scene with such a parameter is
solved with the status `INVALID`. So an argument that is refused when concrete gives `INVALID` when traced. Derivatives
with respect to a traced value are unchanged inside its range and NaN outside.
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
    """An interval: `low < value < high`, or `low <= value < high` if `closed`.

    one: words for one number of the interval.
    many: words for several of them.
    low: lower bound.
    high: upper bound, excluded.
    closed: whether `low` belongs to the interval.
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


# Error messages show arrays of up to this many entries in full.
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
    """Check real numbers. Returns a NumPy array, or a traced array with NaN for values outside the range.

    Args:
        name: name of the argument.
        value: what was passed for it.
        within: the range.
        shapes: the shapes allowed; any by default.
        each: what an entry stands for, such as "one for each tendon".
        why: the reason for the range, or the cure.

    Raises:
        ValueError: the dtype or the shape is wrong, or a concrete number lies outside the range.
    """
    return inside(name, shaped(name, value, shapes, each), within, within.many, why)


def number(name: str, value: Any, within: Range = FINITE, why: str = "") -> Any:
    """Check one real number, as `numbers` does for arrays."""
    array = real(name, value, "a real number")
    if array.ndim:
        raise ValueError(f"{name}: expected {within.one}, got {_shown(value)}")
    return inside(name, array, within, within.one, why)


def setting(name: str, value: Any, within: Range = FINITE, why: str = "") -> float:
    """Check one real number that must be concrete, because the host or the compiler needs its value."""
    if not is_concrete(value):
        raise ValueError(f"{name}: expected {within.one}, got a traced value; give a Python number")
    return float(number(name, value, within, why))


def inside(name: str, array: Any, within: Range, words: str = "", why: str = "") -> Any:
    """Check the range of an array from `real`. The message calls the range `words`, by default `within.many`."""
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
    """Traced values where they are good, else NaN. Derivatives are NaN there too: zeros would look like results."""
    return values * jnp.where(good, 1.0, jnp.nan)


def shaped(name: str, value: Any, shapes: tuple[Shape, ...] | None, each: str = "") -> Any:
    """Check real numbers of one of these shapes. Their range is not checked."""
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
    """Convert to an array of floats or whole numbers: of NumPy if the values are concrete, of JAX if traced."""
    array = plain(name, value, expected)
    if array.dtype.kind not in "fiu" or (array.dtype.itemsize < 4 and array.dtype.kind == "f"):
        raise ValueError(f"{name}: expected {expected}, got {_shown(value, array)}; {_cure(array.dtype)}")
    return array


def plain(name: str, value: Any, expected: str) -> Any:
    """Convert to an array of any dtype: of NumPy if the values are concrete, of JAX if traced."""
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
    """Short description of what was passed."""
    if array is not None and array.ndim and array.dtype.kind != "O":
        return f"dtype {array.dtype}"
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _cure(dtype: Any) -> str:
    """How to convert numbers of a dtype that is refused."""
    if dtype.kind == "c":
        return "take the real part with .real"
    if dtype.kind == "f" or "float" in str(dtype):
        return "convert it to float32 or float64, float16 has too few digits"
    return "convert it with float(...) or .astype(float)"


# -------------------------------------------------------------------------------------- settings and names


def count(name: str, value: Any, least: int, most: int | None = None, why: str = "") -> int:
    """Check a whole number from `least` to `most`, both included."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or value < least or (most is not None and value > most):
        span = f"of at least {least}" if most is None else f"from {least} to {most}"
        raise ValueError(f"{name}: expected a whole number {span}{', ' * bool(why)}{why}, got {_shown(value)}")
    return int(value)


def flag(name: str, value: Any) -> bool:
    """Check `True` or `False`. Other values are refused: a string such as "no" counts as true in Python."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name}: expected True or False, got {_shown(value)}")
    return bool(value)


def function(name: str, value: Any, form: str) -> Any:
    """Check that `value` can be called. `form` shows its arguments in the message."""
    if not callable(value):
        raise ValueError(f"{name}: expected a function {form}, got {_shown(value)}")
    return value


def scalar(name: str, form: str, value: Any, *arguments: Any) -> None:
    """Refuse a function `value` that does not return one real number for these arguments. It is traced, not run."""
    found = jax.eval_shape(value, *arguments)
    if getattr(found, "shape", None) != () or found.dtype.kind != "f":
        raise ValueError(f"{name}: expected a function {form} that returns one real number, got {found}")


def parameter(name: str, value: Any) -> Any:
    """Check one leaf of the parameters of a term: an array of real numbers or booleans, and not of float16."""
    array = value if isinstance(value, jax.Array | np.ndarray) else plain(name, value, "numbers")
    if isinstance(value, np.ma.MaskedArray) or array.dtype.kind not in "fiub" or array.dtype in (np.float16,):
        real(name, value)
    return array


def instance(name: str, value: T, kind: type, cure: str) -> T:
    """Check that `value` is an instance of the class `kind`."""
    if not isinstance(value, kind):
        got = f"the class {value.__name__} itself" if isinstance(value, type) else f"a {type(value).__name__}"
        raise ValueError(f"{name}: expected a {kind.__name__}, got {got}; {cure}")
    return value


def float_dtype(name: str, value: Any) -> Any:
    """Check a dtype to compute in: float32 or float64. `None` gives JAX's default float dtype."""
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
    """Check node numbers from 0 to `total - 1`, in an array of `ndim` axes that is not empty."""
    if not is_concrete(value):
        raise ValueError(f"{name}: expected concrete node numbers, got a traced array")
    shape = "(m,)" if ndim == 1 else "(m, k)"
    array = plain(name, value, f"whole numbers of shape {shape}")
    if array.dtype.kind not in "iu" or array.ndim != ndim or array.size == 0:
        got = f"shape {array.shape}" + (", which is empty" if array.size == 0 else f" of {array.dtype}")
        points = array.dtype.kind == "f" and array.ndim == ndim + 1 and array.shape[-1] == 2
        cure = "; choose nodes by points with nearest_node(mesh, points)" if points else ""
        raise ValueError(f"{name}: expected whole numbers of shape {shape}, got {got}{cure}")
    outside = array[(array < 0) | (array >= total)]
    if outside.size:
        raise ValueError(f"{name}: {outside[0]} is out of range, nodes are numbered 0 to {total - 1}")
    return array


def whole_numbers(name: str, value: Any, shape: str, columns: tuple[int, ...]) -> np.ndarray:
    """Check node numbers `(m, c)` with `m >= 1` and `c` in `columns`. Returns a read-only array for an index field."""
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
    """Check positions of all nodes.

    A JAX array of floats is returned as it is. Plain numbers are converted to a JAX array of `dtype`.
    """
    expected = f"node positions of shape {shape}"
    if hasattr(value, "status") and hasattr(value, "x"):
        raise ValueError(f"{name}: expected {expected}, got a {type(value).__name__}; give its positions, solution.x")
    # Do not copy a JAX array to the host: that would wait until it is computed.
    array = value if isinstance(value, jax.Array) else real(name, value, expected)
    if (array.dtype.kind != "f" and isinstance(value, jax.Array)) or array.dtype.itemsize < 4:
        raise ValueError(f"{name}: expected {expected}, got dtype {array.dtype}; {_cure(array.dtype)}")
    if array.shape != shape:
        many = array.ndim == len(shape) + 1 and array.shape[1:] == shape
        cure = f"; give one state, {name}[-1], or all by jax.vmap(lambda {name}: measure(scene, {name}))({name})"
        cure = cure if many else "; commands are set by command(scene, values)" * (array.ndim == 1)
        raise ValueError(f"{name}: expected {expected}, got {array.shape}{cure}")
    return array if isinstance(array, jax.Array) else to_device(array, dtype)
