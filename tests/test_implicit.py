"""The derivative through equilibrium: against differences of converged solves, and where there is none."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import counted, spring_pair, traces

import jaxbeam as jb

# Differences divide the error of a solve by a step of about 1e-3, so solves go as far down as round-off lets them.
TIGHT = jb.Newton(rtol=1e-12)
# Demanded: implicit first derivatives against differences, second against differences of the first.
FIRST, SECOND = 1e-7, 1e-6


def differences(f, h):
    """Slope of `f` at 0 by the central stencil of order 6, whose truncation is about `h^6`."""
    return sum(w * (np.asarray(f(k * h)) - np.asarray(f(-k * h))) for k, w in ((1, 45), (2, -9), (3, 1))) / (60 * h)


# ------------------------------------------------------- a beam with every kind of parameter


def strap(x, params):
    """A user's own term: a spring in the square of the distance of two nodes."""
    return params["stiffness"] * (jnp.sum((x[1] - x[0]) ** 2) - params["length"] ** 2) ** 2


def parameters(beam, ratios):
    """Those of a `tendon_beam`, of a load on its tip and of a strap; the last two of no strength."""
    count = len(beam.mesh.elements)
    return {
        "ratios": jnp.asarray(ratios),
        "modulus": jnp.full(2, 2e3),
        "young": jnp.full(count, 1e4),
        "poisson": jnp.full(count, 0.45),
        "load": jnp.zeros((beam.tip.size, 2)),
        "nodes": beam.mesh.nodes,
        "strap": {"stiffness": jnp.zeros(1), "length": jnp.ones(1)},
    }


def built(beam, theta):
    """The scene of these parameters on the topology of `beam`."""
    mesh = jb.Mesh(theta["nodes"], beam.mesh.elements)
    terms = (
        jb.solid(mesh, jb.lame(theta["young"], theta["poisson"]), counted),
        jb.tendons(mesh, beam.terms[1].nodes, theta["modulus"]),
        jb.dead_load(mesh, beam.tip, theta["load"]),
        jb.Term(strap, [[0, beam.tip[-1]]], theta["strap"]),
    )
    return jb.command(jb.Scene(mesh, terms, beam.fixed, beam.tip), theta["ratios"])


def changes(beam, seed=0):
    """A change of the parameters of each kind, in a random direction if of an array. A step of 1 is a large one."""
    rng = np.random.default_rng(seed)
    count = len(beam.mesh.elements)
    corner, above = np.asarray(beam.mesh.nodes[:2])
    shape = lambda: (above - corner)[1] * rng.standard_normal(beam.mesh.nodes.shape)
    return {
        "top command": {"ratios": np.array([1.0, 0.0])},
        "bottom command": {"ratios": np.array([0.0, 1.0])},
        "top modulus": {"modulus": np.array([2e3, 0.0])},
        "bottom modulus": {"modulus": np.array([0.0, 2e3])},
        "each Young's modulus": {"young": 1e4 * rng.standard_normal(count)},
        "all Young's moduli": {"young": np.full(count, 1e4)},
        "each Poisson's ratio": {"poisson": 0.1 * rng.standard_normal(count)},
        "all Poisson's ratios": {"poisson": np.full(count, 0.1)},
        "load": {"load": 50 * rng.standard_normal((beam.tip.size, 2))},
        "shape": {"nodes": shape()},
        "shape of the clamp": {"nodes": shape() * beam.fixed},
        "own stiffness": {"strap": {"stiffness": np.array([10.0]), "length": np.zeros(1)}},
        "own length": {"strap": {"stiffness": np.zeros(1), "length": np.ones(1)}},
    }


def directions(beam):
    """All the `changes`, stacked."""
    zero = jax.tree.map(np.zeros_like, parameters(beam, [1.0, 1.0]))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *(zero | change for change in changes(beam).values()))


def moved(theta, along, steps):
    """The parameters after `steps` `(k,)` along the `k` directions."""
    return jax.tree.map(lambda value, change: value + jnp.tensordot(steps, change, 1), theta, along)


# ------------------------------------------------------------------------ the reference scene

REFERENCE = jb.tendon_beam()
KINDS = list(changes(REFERENCE))
each_kind = pytest.mark.parametrize("kind", KINDS)
REFERENCE_THETA, REFERENCE_ALONG = parameters(REFERENCE, [0.4, 1.0]), directions(REFERENCE)


def reference_angle(steps):
    scene = built(REFERENCE, moved(REFERENCE_THETA, REFERENCE_ALONG, steps))
    solution = jb.equilibrium(scene, None, TIGHT)
    return jb.tip_angle(scene, solution.x), solution


@jax.jit
def expansion(steps):
    """Tip angle of the reference scene after `steps` along the `KINDS`: gradient in both modes, Hessian, solution."""

    def first(steps):
        (angle, solution), gradient = jax.value_and_grad(reference_angle, has_aux=True)(steps)
        return (angle, gradient), (angle, gradient, solution)

    (forward, hessian), (angle, reverse, solution) = jax.jacfwd(first, has_aux=True)(steps)
    return {"angle": angle, "forward": forward, "reverse": reverse, "hessian": hessian, "solution": solution}


AT_COMMANDS = {"(0.4, 1.0)": np.zeros(len(KINDS)), "(0.6, 1.0)": 0.2 * np.eye(len(KINDS))[0]}
each_command = pytest.mark.parametrize("steps", AT_COMMANDS.values(), ids=AT_COMMANDS)


def test_reference_lengths():
    """By the commanded lengths, degrees per length, as central differences of another code give them."""
    at = expansion(np.zeros(len(KINDS)))
    assert abs(at["angle"] - 35.5152802) < 1e-6  # it is the reference scene
    np.testing.assert_allclose(at["reverse"][:2] / 1.75, [-21.18765, 3.82786], rtol=1e-5)


@each_command
@each_kind
def test_reference_differences(kind, steps):
    """First derivatives against differences of values, second ones against differences of the first."""
    axis = np.eye(len(KINDS))[KINDS.index(kind)]
    column = lambda t: np.append((at := expansion(steps + t * axis))["angle"], at["reverse"])
    at, found = expansion(steps), differences(column, 1e-3)
    assert int(at["solution"].status) == jb.Status.OK
    np.testing.assert_allclose(at["reverse"][KINDS.index(kind)], found[0], rtol=FIRST)
    hessian = at["hessian"][KINDS.index(kind)]
    np.testing.assert_allclose(hessian, found[1:], rtol=0, atol=SECOND * np.abs(hessian).max())


@each_command
def test_forward_is_reverse(steps):
    at = expansion(steps)
    np.testing.assert_allclose(at["forward"], at["reverse"], rtol=1e-10)
    np.testing.assert_allclose(at["hessian"], at["hessian"].T, rtol=0, atol=1e-10 * np.abs(at["hessian"]).max())


@each_command
def test_taylor_remainders(steps):
    """What the linear and the quadratic model leave is of order 2 and 3, over two decades of step."""
    d = np.random.default_rng(1).uniform(-1, 1, len(KINDS))
    at = expansion(steps)
    slope, curvature = d @ at["reverse"], d @ at["hessian"] @ d
    sizes = np.geomspace(1e-4, 1e-2, 9)
    change = np.array([expansion(steps + h * d)["angle"] - at["angle"] for h in sizes])
    linear = np.abs(change - sizes * slope)
    quadratic = np.abs(change - sizes * slope - 0.5 * sizes**2 * curvature)
    print(linear, quadratic)
    order = lambda remainder: np.polyfit(np.log(sizes), np.log(remainder), 1)[0]
    assert order(linear) == pytest.approx(2, abs=0.02)
    assert order(quadratic) == pytest.approx(3, abs=0.02)
