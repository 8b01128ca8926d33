"""jaxbeam against published values, closed forms, scikit-fem and a manufactured solution: `benchmarks/verification.py`.

What is solved and where the reference values come from is written there; it prints more meshes and cases than are
asserted here.
"""

import numpy as np
import pytest

import jaxbeam as jb
from benchmarks import verification

# Corners along the slender beams: enough for the errors below, and one shape for all of them.
ALONG = 81


@pytest.mark.parametrize(
    ("cells", "order", "rtol"),
    [
        pytest.param(16, 2, 2e-3, id="P2", marks=pytest.mark.slow),
        pytest.param(64, 2, 2e-4, id="P2 fine", marks=pytest.mark.slow),
        pytest.param(64, 1, 7e-3, id="P1 fine", marks=pytest.mark.slow),
    ],
)
def test_cooks_membrane(cells, order, rtol):
    """Within the error of the mesh, on the stiff side, of where the published table ends; it has four digits."""
    found = verification.cook_deflection(cells, order)
    assert (1 - rtol) * verification.COOK_LIMIT < found < verification.COOK_LIMIT + 0.005


@pytest.mark.slow
def test_elastica():
    """Shear, extension and finite strain are of the size of (H/L)^2, and larger than the error of the mesh."""
    length = 100.0
    for load, published in verification.MATTIASSON.items():
        np.testing.assert_allclose(verification.elastica_deflection(load), published, atol=5.1e-6)
        found = verification.cantilever_deflection(load, length, along=ALONG)
        np.testing.assert_allclose(found, published, rtol=2 / length**2, atol=5.1e-6)


@pytest.mark.slow
def test_a_moment_bends_a_strip_to_a_circle():
    """Beam theory to the (kappa H)^2 / 6 of finite strain; to a few 1e-4 with it, the error of the mesh."""
    length = 50.0
    turn, moved, reduced = verification.rolled_up(length, 360.0, 8, along=ALONG)
    np.testing.assert_allclose(reduced, 2 * np.pi, rtol=1e-14)
    np.testing.assert_allclose(turn, verification.bending_rotation(reduced, length), rtol=3e-4)
    strain = reduced / length
    assert abs(turn / reduced - 1) < strain**2 / 6
    # The end comes back to the clamp, but for the rotation in excess.
    np.testing.assert_allclose(moved, [-1, 0], atol=strain**2 / 6)


@pytest.mark.slow
def test_euler_load():
    """The error falls as (H/L)^2: four times less where the column is twice as slender."""
    errors = [verification.critical_load(length, along=ALONG) - 1 for length in (10.0, 20.0)]
    assert abs(errors[0]) < 1e-3
    np.testing.assert_allclose(errors[0] / errors[1], 4, rtol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_orders_of_convergence(order):
    """In L2 one more than the degree, in the energy norm the degree."""
    # It compiles in half the time of what would be chosen for a square.
    solver = jb.Newton(linear=jb.BlockTridiagonal())
    coarse, fine = (verification.manufactured_errors(cells, order, solver) for cells in (8, 16))
    observed = np.log2(np.array(coarse) / np.array(fine))
    np.testing.assert_allclose(observed, verification.ORDERS[order], atol=0.1)


@pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("ratios", verification.PEER_RATIOS)
def test_scikit_fem_finds_the_same(order, ratios):
    """Eight digits of the tip angle, and of all positions and lengths relative to the beam."""
    pytest.importorskip("skfem")
    found = verification.compare_packages(verification.by_scikit_fem, order, ratios)
    np.testing.assert_allclose(*found["angles"], rtol=1e-8)
    assert max(found["apart"], found["lengths"]) < 1e-8


@pytest.mark.parametrize("ratios", verification.PEER_RATIOS)
def test_felupe_finds_the_same(ratios):
    pytest.importorskip("felupe")
    found = verification.compare_packages(verification.by_felupe, 1, ratios)
    np.testing.assert_allclose(*found["angles"], rtol=1e-8)
    assert max(found["apart"], found["lengths"]) < 1e-8
