"""How solutions show themselves: facts, remedies, pictures; and the outline, which every transformation keeps."""

import dataclasses
import xml.etree.ElementTree as ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import small_beam, solution_of, spring_pair, traces

import jaxbeam as jb
from jaxbeam.core.tree import replace
from jaxbeam.mesh.sketch import OUTLINE, WARNING
from jaxbeam.mesh.surface import outline
from jaxbeam.solve.solution import PALE, REMEDIES, SHOWN, outlined

RATIOS = np.array([[0.9, 1.0], [0.8, 1.0], [1.0, 0.9]])


@pytest.fixture(scope="module")
def small():
    return small_beam()


@pytest.fixture(scope="module")
def solution(small):
    return jb.check(jb.equilibrium(jb.command(small, RATIOS[0])))


def paths(html):
    """Attributes of the paths in a page of HTML, which must be well formed."""
    root = ElementTree.fromstring(html.replace("&middot;", "").replace("<br>", "<br/>"))
    return [path.attrib for path in root.iter("{http://www.w3.org/2000/svg}path")]


def by_hand(scene, x, status):
    return outlined(solution_of(scene, np.ones((*np.shape(status), 2)), x, status), scene.mesh)


# ------------------------------------------------------------------------------------------------ words


def test_facts_in_lines(steered):
    lines = str(steered[1]).split("\n")
    assert lines[0] == "Solution: OK" and len(lines) == 4
    assert lines[1].startswith("  residual ") and lines[1].endswith(f"after {steered[1].steps} Newton steps")
    assert lines[2].startswith("  smallest J 0.718 in element ") and lines[3] == "  command [0.4, 1.0]"
    pair = jb.equilibrium(spring_pair(0.9), solver=jb.Newton(linear=jb.Dense()))
    assert "smallest J" not in str(pair) and "smallest J" not in repr(pair)


def test_facts_of_a_batch(bent_path):
    volumes = np.asarray(bent_path.smallest_jacobian)
    assert repr(bent_path) == (
        f"Solution(28 states: 28 OK; smallest J {volumes.min():.3g} to {volumes.max():.3g}, "
        f"{np.sum(bent_path.steps)} Newton steps)"
    )
    assert str(bent_path).startswith("Solution: 28 states: 28 OK\n  smallest J 0.7")


def test_one_remedy_for_each_flag(small):
    states = by_hand(small, np.stack([small.mesh.nodes] * 4), [0, 1 | 8, 4, 1])
    lines = str(states).split("\n  ")
    assert lines[0] == "Solution: 4 states: 1 OK, 1 NOT_CONVERGED, 1 INVERTED, 1 NOT_CONVERGED|UNSTABLE"
    flags = (jb.Status.NOT_CONVERGED, jb.Status.INVERTED, jb.Status.UNSTABLE)
    assert lines[3:] == [f"{flag.name}: {REMEDIES[flag]}" for flag in flags]
    assert "\n" not in repr(states)
    html = states._repr_html_()
    assert all(f"{flag.name}: " in html for flag in flags) and html.count(f"color:{WARNING}") == 1


def test_only_what_is_not_ok_is_in_colour(small, solution):
    assert WARNING not in solution._repr_html_() and "OK; residual" in solution._repr_html_()
    failed = replace(solution, status=jnp.int32(8))
    assert f'<b style="color:{WARNING}">UNSTABLE</b>' in failed._repr_html_()
    assert [path["stroke"] for path in paths(failed._repr_html_())] == [WARNING]


# ------------------------------------------------------------------------------------------------ pictures


def test_one_state_is_its_body(solution):
    (path,) = paths(solution._repr_html_())
    assert path["stroke"] == OUTLINE and path["d"].count("M") == 1 and path["d"].endswith("Z")
    # A corner of each of the 12 edges of the surface.
    assert path["d"].count(",") == 12 + 1


def test_of_a_batch_a_few_states_are_pale_and_the_last_one_strong(bent_path):
    found = paths(bent_path._repr_html_())
    assert len(found) == SHOWN < 28
    assert [float(path.get("opacity", 1)) for path in found] == [PALE] * (SHOWN - 1) + [1]
    two = jax.tree.map(lambda leaf: leaf[:2], bent_path)
    assert len(paths(two._repr_html_())) == 2
    nested = jax.tree.map(lambda leaf: leaf[:6].reshape(2, 3, *leaf.shape[1:]), bent_path)
    assert len(paths(nested._repr_html_())) == 6 and repr(nested).startswith("Solution(6 states: 6 OK")
    none = jax.tree.map(lambda leaf: leaf[:0], bent_path)
    assert "<svg" not in none._repr_html_() and repr(none) == "Solution(0 states: ; 0 Newton steps)"


def test_states_that_are_not_finite_are_left_out(small):
    rest = np.asarray(small.mesh.nodes)
    for bad in (np.nan, np.inf, -np.inf):
        states = by_hand(small, np.stack([rest, np.where(np.arange(15)[:, None] == 3, bad, rest)]), [0, 2])
        assert len(paths(states._repr_html_())) == 1
        assert "<svg" not in jax.tree.map(lambda leaf: leaf[1], states)._repr_html_()


def test_without_an_outline_nodes_are_dots(solution):
    for unknown in (None, jnp.zeros(()), np.zeros(3, int), np.array([[0, 99]])):
        (path,) = paths(replace(solution, outline=unknown)._repr_html_())
        assert path["d"].count("h0") == 15


def test_rods_and_curved_edges():
    rod = jb.rod_beam(nodes=9)
    (path,) = paths(by_hand(rod, rod.mesh.nodes, 0)._repr_html_())
    assert path["fill"] == "none" and path["d"].count(",") == 9
    six = jb.tendon_beam(3, 2, order=2)
    x = np.asarray(six.mesh.nodes) + 0.1 * np.sin(3 * np.asarray(six.mesh.nodes)[:, :1]) * [0, 1]
    (path,) = paths(by_hand(six, x, 0)._repr_html_())
    assert path["d"].count(",") == 6 * 6 + 1


def test_trees_of_other_values_show_text(solution):
    """Placeholders, tangents, values of other kinds, traced and deleted ones."""
    tangent = jax.jvp(lambda r: replace(solution, x=r * solution.x), (1.0,), (1.0,))[1]
    gone = jax.tree.map(lambda leaf: leaf + 0, solution)
    jax.tree.map(lambda leaf: leaf.delete(), gone)
    others = {
        "a tree of other values": [
            jax.tree.map(lambda leaf: None, solution),
            jax.tree.map(lambda leaf: object(), solution),
            jb.Solution(*[solution.x] * len(dataclasses.fields(jb.Solution))),
            tangent,
        ],
        "deleted": [gone],
    }
    for words, trees in others.items():
        for each in trees:
            assert repr(each) == f"Solution({words})" and str(each) == f"Solution: {words}"
            assert words in each._repr_html_() and "<svg" not in each._repr_html_()
    said = []
    jax.eval_shape(lambda each: said.append((repr(each), str(each), each._repr_html_())), solution)
    assert said[0][:2] == ("Solution(traced)", "Solution: traced") and "<svg" not in said[0][2]


# ------------------------------------------------------------------------------------------------ the outline


def test_every_solve_gives_the_outline(small, solution):
    expected = outline(small.mesh)
    found = {
        "equilibrium": solution,
        "ramp": jb.ramp(small, [0.9, 1.0], 3),
        "sweep": jb.sweep(small, RATIOS),
        "reach": jb.reach(small, 2.0).solution,
    }
    for name, each in found.items():
        np.testing.assert_array_equal(each.outline, expected, err_msg=name)
        assert isinstance(each.outline, np.ndarray) and not each.outline.flags.writeable


def test_transformations_keep_it(small):
    """It is structure: `jit`, `vmap`, `scan`, `map`, `grad` with the solution beside the value, slices and stacks."""
    solve = lambda ratios: jb.equilibrium(jb.command(small, ratios))
    value_and_solution = lambda ratios: ((found := solve(ratios)).energy, found)
    (_, beside), slope = jax.value_and_grad(value_and_solution, has_aux=True)(jnp.asarray(RATIOS[0]))
    rows = jnp.asarray(RATIOS)
    found = {
        "jit": jax.jit(solve)(rows[0]),
        "vmap": jax.vmap(solve)(rows),
        "map": jax.lax.map(solve, rows),
        "scan": jax.lax.scan(lambda _, row: (solve(row),) * 2, solve(rows[0]), rows)[1],
        "grad": beside,
        "stack": jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(solve, rows)),
        "slice": jax.tree.map(lambda leaf: leaf[1], jax.vmap(solve)(rows)),
    }
    assert jnp.all(jnp.isfinite(slope))
    for name, each in found.items():
        np.testing.assert_array_equal(each.outline, outline(small.mesh), err_msg=name)
        assert "<svg" in each._repr_html_()
        assert jax.tree.structure(each) == jax.tree.structure(found["jit"])


def test_solutions_of_other_anchors_and_diagonals_stack(small, solution):
    """A study of designs stacks solutions of scenes whose tendons or diagonals differ."""
    moved = jb.Scene(small.mesh, (small.terms[0], jb.tendons(small.mesh, [[0, 12], [2, 14]], 2e3)), small.fixed)
    each = [jb.equilibrium(jb.command(scene, RATIOS[0])) for scene in (moved, small_beam(diagonals="mirrored"))]
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), solution, *each)
    assert len(paths(both._repr_html_())) == 3


def test_another_topology_compiles_nothing(small):
    """A mesh of the same shape with another outline: its nodes are numbered along the beam instead of across."""
    number = np.arange(15).reshape(3, 5).T.ravel()
    mesh = jb.Mesh(np.asarray(small.mesh.nodes)[np.argsort(number)], number[small.mesh.elements])
    tendons = jb.tendons(mesh, number[small.terms[1].nodes], 2e3)
    body = jb.solid(mesh, jb.lame(1e4, 0.45), small.terms[0].energy.density)
    other = jb.Scene(mesh, (body, tendons), small.fixed[np.argsort(number)], number[small.tip])
    assert not np.array_equal(outline(mesh), outline(small.mesh))
    solves = (
        lambda scene: jb.equilibrium(jb.command(scene, RATIOS[0])),
        lambda scene: jb.ramp(scene, [0.9, 1.0], 3),
        lambda scene: jb.sweep(scene, RATIOS),
    )
    first = [solve(small) for solve in solves]
    before = traces["density"]
    for solve, mine in zip(solves, first, strict=True):
        found = jb.check(solve(other))
        np.testing.assert_allclose(np.asarray(found.x)[..., number, :], mine.x, atol=1e-7)
        np.testing.assert_array_equal(found.outline, outline(mesh))
    assert traces["density"] == before
