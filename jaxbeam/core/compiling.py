"""How programs are compiled and run: options of XLA, JAX's settings, and loops that do only what is wanted."""

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


def blank(function: Callable[..., Any], *arguments: Any) -> Any:
    """Zeros in the shape of what a function returns, which is traced and not run: a value to start a loop with."""
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(function, *arguments))


def once(wanted: jax.Array | bool, compute: Callable[..., T], otherwise: T, *arguments: Any) -> T:
    """`compute(*arguments)` where that is `wanted`, and where it is not `otherwise`, at no cost.

    A loop of at most one turn, and not `lax.cond`: under `vmap` a cond becomes a select, and every lane would always
    pay. What it computes must depend on the arguments alone.
    """
    if isinstance(wanted, bool):
        return compute(*arguments) if wanted else otherwise

    def turn(carry: tuple[T, jax.Array]) -> tuple[T, jax.Array]:
        # Tied to the loop's state: XLA moves what does not change out of a loop, and it would be computed always.
        _, tied = lax.optimization_barrier((carry, arguments))
        return compute(*tied), jnp.zeros((), bool)

    return lax.while_loop(lambda carry: carry[1], turn, (otherwise, wanted))[0]


def choose(condition: jax.Array, yes: T, no: T) -> T:
    """One of two trees of the same structure, by a traced `()` boolean."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


# What makes XLA compile the solver's many small kernels in less than half the time, and they run no slower: its older
# emitters, and no passes that search its loops for what there is not: anything to move out of them, or to drop. The
# last one would split each sum in two, for a round-off that the line search is far above.
_PASSES = "while-loop-invariant-code-motion,simplify-while-loops,tree_reduction_rewriter"


_QUICKLY = {"xla_cpu_use_fusion_emitters": False, "xla_disable_hlo_passes": _PASSES}


# A later version may not know them.
COMPILER_OPTIONS = _QUICKLY if (0, 10) <= jax.__version_info__ < (0, 11) else None


def outside() -> bool:
    """Whether this is run, not traced: what a jitted function returns is a tracer inside another one."""
    return is_concrete(_zero())


_zero = jax.jit(lambda: np.int32(0))


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Without Python's search for reference cycles, which finds none in what tracing makes and takes a tenth of it."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def usual_rules(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator: run under JAX's default rules for ranks, dtypes and transfers, whatever the user has set.

    A user who forbids implicit promotion or transfers means their own code. Here arrays of different rank meet by
    intention, and index arrays of a topology are sent to the device when they are first needed.
    """

    @functools.wraps(function)
    def call(*arguments: P.args, **named: P.kwargs) -> T:
        with (
            jax.numpy_rank_promotion("allow"),
            jax.numpy_dtype_promotion("standard"),
            jax.transfer_guard("allow"),
        ):
            return function(*arguments, **named)

    return call


def compiled(*static: str) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """Decorator: `jax.jit` with static arguments of these names, for the solver's own entry points.

    Called outside any transformation it is compiled with our own options, which JAX takes nowhere else. Under `vmap` it
    solves lane after lane: batched, all lanes would do what any of them needs.
    """

    def decorate(function: Callable[..., T]) -> Callable[..., T]:

        @functools.wraps(function)
        def traced(**values: Any) -> T:
            _refuse_varying(values)
            return function(**values)

        inner = jax.jit(traced, static_argnames=static)
        outermost = jax.jit(traced, static_argnames=static, compiler_options=COMPILER_OPTIONS)
        signature = inspect.signature(function)

        @functools.wraps(function)
        @usual_rules
        def call(*arguments: Any, **named: Any) -> T:
            values = signature.bind(*arguments, **named).arguments
            settings = {name: values.pop(name) for name in static}
            if is_concrete(*jax.tree.leaves(values)) and outside():
                with _uncollected():
                    return outermost(**values, **settings)
            in_turn = jax.custom_batching.sequential_vmap(lambda values: inner(**values, **settings))
            return in_turn(values)

        return call

    return decorate


def _refuse_varying(values: Any) -> None:
    """Refuse values that `jax.shard_map` marks as different on each device, which loops from constants do not take."""
    for leaf in jax.tree.leaves(values):
        kind = jax.typeof(leaf) if isinstance(leaf, Tracer) else None
        # The second is its name from jax 0.10 on.
        if getattr(kind, "vma", None) or getattr(getattr(kind, "manual_axis_type", None), "varying", None):
            raise ValueError(
                "jax.shard_map: the solver's loops start from constants, which its check of varying values refuses; "
                "call it with check_vma=False, or use sweep, which runs on all devices by itself"
            )
