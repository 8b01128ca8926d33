"""How programs are compiled and run: XLA's options, JAX's settings, and a branch that costs nothing when not taken."""

from __future__ import annotations

import contextlib
import functools
import gc
import inspect
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer

from jaxbeam.core.tree import T, is_concrete

P = ParamSpec("P")


def zeros_like_result(function: Callable[..., Any], *arguments: Any) -> Any:
    """Zeros with the structure of a function's result, to start a loop with. The function is traced, not run."""
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(function, *arguments))


def compute_if(condition: jax.Array | bool, compute: Callable[..., T], otherwise: T, *arguments: Any) -> T:
    """`compute(*arguments)` if the condition holds; else `otherwise`, and nothing is computed.

    This is a loop of at most one iteration instead of `lax.cond`: under `vmap` a cond becomes a select, which always
    computes both sides. Under `vmap` the loop is skipped if the condition holds in no lane. It cannot be differentiated
    in reverse mode.

    Args:
        condition: `()` traced boolean, or a Python boolean, which is decided while tracing.
        compute: a function. XLA may compute in advance what it makes of traced values that are not `arguments`.
        otherwise: a tree with the structure, shapes and dtypes of the result of `compute`.
        arguments: the arguments of `compute`.
    """
    if isinstance(condition, bool):
        return compute(*arguments) if condition else otherwise

    def iteration(carry: tuple[T, jax.Array]) -> tuple[T, jax.Array]:
        # The barrier makes the arguments depend on the carry. XLA would move operations that do not depend on it out of
        # the loop, and then they would run even if the loop does not.
        _, inside = lax.optimization_barrier((carry, arguments))
        return compute(*inside), jnp.zeros((), bool)  # False: stop after this iteration

    return lax.while_loop(lambda carry: carry[1], iteration, (otherwise, condition))[0]


def choose(condition: jax.Array, yes: T, no: T) -> T:
    """`jnp.where` for trees: `yes` if the traced `()` condition holds, else `no`, which has the same structure."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


# With these options XLA compiles the solver's many small kernels in less than half the time, and they run no slower.
# The first option selects XLA's older emitters. The second disables three passes: two find nothing in the solver's
# loops; the third splits each sum in two to lower round-off, which the line search allows for anyway.
_DISABLED_PASSES = "while-loop-invariant-code-motion,simplify-while-loops,tree_reduction_rewriter"
_FAST_COMPILATION = {"xla_cpu_use_fusion_emitters": False, "xla_disable_hlo_passes": _DISABLED_PASSES}
# Other versions of JAX may not know these options.
COMPILER_OPTIONS = _FAST_COMPILATION if (0, 10) <= jax.__version_info__ < (0, 11) else None


def is_outermost() -> bool:
    """Whether the caller is outside every transformation. Inside one, a jitted function returns a tracer."""
    return is_concrete(_zero())


_zero = jax.jit(lambda: np.int32(0))


@contextlib.contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """Context with Python's cycle collector off: it takes a tenth of the time of tracing and finds no cycles."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def _rules_are_usual() -> bool:
    """Whether JAX's default rules for ranks, dtypes and transfers are in force."""
    ways = ("host_to_device", "device_to_device", "device_to_host")
    guards = {getattr(jax.config, f"jax_transfer_guard_{way}") for way in ways}
    ranks, dtypes = (getattr(jax.config, f"jax_numpy_{kind}_promotion") for kind in ("rank", "dtype"))
    return ranks == "allow" and dtypes == "standard" and guards <= {None, "allow"}


def usual_rules(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator: run under JAX's default rules for ranks, dtypes and transfers, whatever the user has set.

    A user may forbid implicit promotion or transfers in their own code. This package relies on both: it combines arrays
    of different rank, and sends the index arrays of a topology to the device when they are first needed.
    """

    @functools.wraps(function)
    def call(*arguments: P.args, **named: P.kwargs) -> T:
        # Usually the rules are the default. Entering three contexts takes longer than the checks of arguments.
        if _rules_are_usual():
            return function(*arguments, **named)
        with (
            jax.numpy_rank_promotion("allow"),
            jax.numpy_dtype_promotion("standard"),
            jax.transfer_guard("allow"),
        ):
            return function(*arguments, **named)

    return call


def compiled(*static: str) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """Decorator: `jax.jit` with static arguments of these names, for the solver's own entry points.

    Outside jit, grad and vmap: compile with `COMPILER_OPTIONS`, which JAX accepts nowhere else. Under vmap: run the
    lanes in sequence, because a batched while-loop runs every lane as long as the slowest.
    """

    def decorate(function: Callable[..., T]) -> Callable[..., T]:

        @functools.wraps(function)
        def traced(**values: Any) -> T:
            _refuse_device_varying(values)
            return function(**values)

        inner = jax.jit(traced, static_argnames=static)
        outermost = jax.jit(traced, static_argnames=static, compiler_options=COMPILER_OPTIONS)
        signature = inspect.signature(function)

        @functools.wraps(function)
        @usual_rules
        def call(*arguments: Any, **named: Any) -> T:
            values = signature.bind(*arguments, **named).arguments
            settings = {name: values.pop(name) for name in static}
            if is_concrete(*jax.tree.leaves(values)) and is_outermost():
                with _without_garbage_collection():
                    return outermost(**values, **settings)
            in_sequence = jax.custom_batching.sequential_vmap(lambda values: inner(**values, **settings))
            return in_sequence(values)

        return call

    return decorate


def one_program(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator: run under JAX's default rules and, outside every transformation, as one jitted program.

    Without jit JAX compiles a program for each operation: the first tip angle took 0.8 s.
    """
    jitted = jax.jit(function, compiler_options=COMPILER_OPTIONS)

    @functools.wraps(function)
    @usual_rules
    def call(*arguments: P.args, **named: P.kwargs) -> T:
        # Other arguments go to the function itself, whose checks say what it expected.
        if all(map(_is_array, jax.tree.leaves((arguments, named)))) and is_outermost():
            return jitted(*arguments, **named)
        return function(*arguments, **named)

    return call


def _is_array(leaf: Any) -> bool:
    """Whether a leaf is a concrete array of real numbers or booleans."""
    plain = type(leaf) is np.ndarray or (isinstance(leaf, jax.Array) and is_concrete(leaf))
    return plain and leaf.dtype.kind in "biuf"


def _refuse_device_varying(values: Any) -> None:
    """Refuse values that `jax.shard_map` marks as different on each device: loops that start from constants fail."""
    for leaf in jax.tree.leaves(values):
        kind = jax.typeof(leaf) if isinstance(leaf, Tracer) else None
        # JAX 0.10 and later use the second name.
        if getattr(kind, "vma", None) or getattr(getattr(kind, "manual_axis_type", None), "varying", None):
            raise ValueError(
                "jax.shard_map: the solver's loops start from constants, which its check of varying values refuses; "
                "call it with check_vma=False, or use sweep, which runs on all devices by itself"
            )
