"""Derivative rules that call their own function again, under every transformation and to third order."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxbeam.core.derivative import custom_derivative


@functools.partial(custom_derivative, static=1)
def root(power, c):
    """The root of `x^power + x = c^2`, by Newton's method, which is not differentiated."""
    return lax.fori_loop(0, 60, lambda _, x: x - (x**power + x - c**2) / (power * x ** (power - 1) + 1), c)


@root.defjvp
def _(power, primals, tangents):
    (c,), (c_dot,) = primals, tangents
    x = root(power, c)
    return x, 2 * c * c_dot / (power * x ** (power - 1) + 1)


def exact(c: float) -> list[float]:
    """Value and derivatives to third order of the root of `x^3 + x = c^2`, by hand."""
    x = float(np.roots([1, 0, 1, -(c**2)])[-1].real)
    slope = 3 * x**2 + 1
    first = 2 * c / slope
    second = (2 - 6 * x * first**2) / slope
    third = -(18 * x * first * second + 6 * first**3) / slope
    return [x, first, second, third]


def mapped(f):
    return lambda c: lax.map(f, jnp.stack([c, 2 * c]))[0]


def scanned(f):
    return lambda c: lax.scan(lambda carry, d: (carry + f(c + d), None), 0.0 * c, jnp.zeros(1))[0]


WAYS = {
    "plain": lambda f: f,
    "jit": jax.jit,
    "map": mapped,
    "scan": scanned,
    "checkpoint": jax.checkpoint,
    "checkpointed map": lambda f: mapped(jax.checkpoint(f)),
    "vmap": lambda f: lambda c: jax.vmap(f)(jnp.stack([c, 2 * c]))[0],
    "vmap of map": lambda f: lambda c: jax.vmap(mapped(f))(jnp.stack([c, 2 * c]))[0],
    "cond": lambda f: lambda c: lax.cond(c > 0, f, lambda c: 0.0 * c, c),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("modes", ["", "r", "ff", "fr", "rr", "frr"])
def test_derivatives_of_an_implicit_function(way, modes):
    f = WAYS[way](functools.partial(root, 3))
    for mode in modes:
        f = (jax.jacfwd if mode == "f" else jax.jacrev)(f)
    np.testing.assert_allclose(f(jnp.asarray(1.3)), exact(1.3)[len(modes)], rtol=1e-12)


def test_maps_in_maps_over_different_arguments():
    """Each level is mapped over an argument of its own, of a length of its own."""

    @custom_derivative
    def quotient(a, b):
        return a / b

    @quotient.defjvp
    def _(primals, tangents):
        (a, b), (da, db) = primals, tangents
        return quotient(a, b), da / b - a * db / b**2

    a, b = jnp.array([1.0, 2.0, 3.0]), jnp.array([4.0, 5.0])
    table = jax.vmap(jax.vmap(quotient, in_axes=(None, 0)), in_axes=(0, None))
    np.testing.assert_allclose(table(a, b), a[:, None] / b, rtol=1e-15)
    np.testing.assert_allclose(jax.jit(jax.grad(lambda b: jnp.sum(table(a, b))))(b), -6 / b**2, rtol=1e-15)


def test_a_batch_differs_in_some_arguments_only():
    @custom_derivative
    def ratio(scale, parts):
        return {"sum": parts["a"] + parts["b"], "quotient": scale * parts["a"] / parts["b"]}

    @ratio.defjvp
    def _(primals, tangents):
        plain = lambda scale, parts: {"sum": parts["a"] + parts["b"], "quotient": scale * parts["a"] / parts["b"]}
        return ratio(*primals), jax.jvp(plain, primals, tangents)[1]

    a, b = jnp.array([1.0, 2.0, 3.0]), jnp.array(4.0)
    loss = lambda a, b: jnp.sum(jax.vmap(lambda a: ratio(2, {"a": a, "b": b})["quotient"])(a))
    value, slopes = jax.value_and_grad(loss, argnums=(0, 1))(a, b)
    assert value == 3
    np.testing.assert_allclose(slopes[0], [0.5] * 3)
    np.testing.assert_allclose(slopes[1], -0.75)
    np.testing.assert_allclose(jax.hessian(loss)(a, b), np.zeros((3, 3)), atol=1e-15)
