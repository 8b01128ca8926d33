"""How scenes show themselves in a notebook: what is drawn, where, and that no scene stops the notebook."""

import re
import xml.etree.ElementTree as ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import annulus, run_python, small_beam, spring_pair

import jaxbeam as jb
from jaxbeam.mesh.sketch import LOWEST, MARGIN, PALETTE, RIGID, TALLEST, WIDTH, Stroke, chains, svg
from jaxbeam.mesh.surface import outline

MESH = jb.rectangle(3.5, 0.8, 8, 3)
BODY = jb.solid(MESH, jb.lame(1e4, 0.3))
LEFT, TOP, RIGHT = (
    jb.nodes_where(MESH, where) for where in (lambda x, y: x < -1.74, lambda x, y: y > 0.39, lambda x, y: x > 1.74)
)


def scene_with(*terms):
    return jb.Scene(MESH, (BODY, *terms), jb.clamped(MESH, LEFT))


def paths(html):
    """The paths of the picture in a page of HTML, which must be well formed: attributes, and points `(p, 2)` of each
    line."""
    root = ElementTree.fromstring(html.replace("&middot;", "").replace("<br>", "<br/>"))
    found = []
    for path in root.iter("{http://www.w3.org/2000/svg}path"):
        lines = [re.findall(r"(-?[\d.]+),(-?[\d.]+)", line) for line in path.get("d").split("M")[1:]]
        found.append((path.attrib, [np.array(line, float) for line in lines]))
    return found


def drawn(scene, **attributes):
    """All lines of a scene's picture whose path has these attributes."""
    html = scene._repr_html_()
    wanted = attributes.items()
    return [line for found, lines in paths(html) if all(found[k] == v for k, v in wanted) for line in lines]


def test_the_body_keeps_its_shape():
    """The reference beam, its outline scaled alike both ways, with y upward and within the margins."""
    (body,) = drawn(jb.tendon_beam(), fill="#DCE5EE")
    wide, tall = np.ptp(body, axis=0)
    assert wide / tall == pytest.approx(3.5 / 0.8, abs=0.02)
    assert wide > 0.8 * WIDTH and body.min() >= MARGIN
    high = jb.tendon_beam(5, 3, length=1.0, height=3.0)
    (body,) = drawn(high, fill="#DCE5EE")
    # The hatching of the clamp below needs some of the height too.
    assert 0.95 < np.ptp(body[:, 1]) / (TALLEST - 2 * MARGIN) < 1


def test_tendons_and_clamp_lie_on_the_body():
    scene = jb.tendon_beam()
    (body,) = drawn(scene, fill="#DCE5EE")
    (left, top), (right, bottom) = body.min(axis=0), body.max(axis=0)
    first, second = (drawn(scene, stroke=colour, **{"stroke-width": "2"})[0] for colour in PALETTE[:2])
    np.testing.assert_allclose(first, [[left, top], [(left + right) / 2, top]], atol=0.11)
    np.testing.assert_allclose(second, [[left, bottom], [(left + right) / 2, bottom]], atol=0.11)
    (wall,) = drawn(scene, **{"stroke-width": "2.4"})
    assert (wall[:, 0] == left).all() and np.ptp(wall[:, 1]) == pytest.approx(bottom - top)
    # Hatching is outside the body.
    teeth = np.array(drawn(scene, **{"stroke-width": "0.8"}))
    assert len(teeth) > 5 and teeth[..., 0].max() <= left and teeth[:, 1, 0].max() < left


def test_edges_are_curved():
    """A quarter ring of six-node triangles: its outline lies on the circle between nodes too."""
    flat = jb.rectangle(2.0, 1.0, 4, 2, order=2)
    bent = jb.mapped(flat, lambda x, y: ((2 + y) * np.sin(0.7 * x), (2 + y) * np.cos(0.7 * x)))
    scene = jb.Scene(bent, (jb.solid(bent, jb.lame(1.0, 0.3)),), jb.clamped(bent, [0, 7, 14]))
    (body,) = drawn(scene, fill="#DCE5EE")
    assert len(body) > bent.nodes.shape[0]
    # In pixels: the outer circle is 2.5 long units from a centre below the body.
    scale = np.ptp(body[:, 0]) / np.ptp(np.asarray(bent.nodes)[:, 0])
    centre = [body[:, 0].mean(), body[:, 1].min() + 2.5 * scale]
    distance = np.linalg.norm(body - [(body[:, 0].min() + body[:, 0].max()) / 2, centre[1]], axis=1) / scale
    assert np.isclose(distance, 2.5, atol=0.01).sum() > 15 and distance.max() < 2.51


def test_a_rod_and_its_tendons():
    scene = jb.rod_beam()
    (line,) = drawn(scene, **{"stroke-width": "3"})
    above, below = (drawn(scene, stroke=colour, **{"stroke-width": "2"})[0] for colour in PALETTE[:2])
    assert np.ptp(line[:, 1]) == 0 and above[0, 1] < line[0, 1] < below[0, 1]


@pytest.mark.parametrize(
    ("term", "toward"),
    [
        (jb.dead_load(MESH, RIGHT, [0.0, -3.0]), [0, 1]),
        (jb.traction(MESH, TOP, [2.0, 0.0]), [1, 0]),
        (jb.weight(MESH, [0.0, -1.0]), [0, 1]),
    ],
    ids=["load", "traction", "weight"],
)
def test_forces_are_arrows(term, toward):
    """They point the right way, in pixels with y downward; with no force there are none."""
    arrows = drawn(scene_with(term), stroke="#111111", fill="none")
    assert len(arrows) >= 1
    for tail, head in arrows:
        np.testing.assert_allclose((head - tail) / np.linalg.norm(head - tail), toward, atol=0.02)
    assert not drawn(scene_with(), stroke="#111111")
    assert not drawn(scene_with(jb.pressure(MESH, np.arange(24), 0.0)), stroke="#111111")


def test_pressure_pushes_from_outside():
    """All round the body: heads of arrows on it, tails outside."""
    scene = scene_with(jb.pressure(MESH, np.arange(24), 5.0))
    (body,) = drawn(scene, fill="#DCE5EE")
    arrows = np.array(drawn(scene, stroke="#111111", fill="none"))
    low, high = body.min(axis=0), body.max(axis=0)
    assert len(arrows) == 15 and not ((low < arrows) & (arrows < high)).all(axis=-1).any()
    sides = arrows[:, 1] - arrows[:, 0]
    assert {tuple(side) for side in np.sign(np.round(sides, 1))} == {(0, 1), (0, -1), (-1, 0), (1, 0)}


def test_obstacles_are_hatched():
    """A disk below and a half-plane above: boundaries where they are, hatching inside."""
    nodes = np.arange(len(MESH.nodes))
    round_one = jb.contact(MESH, nodes, jb.disk([0.5, -1.0], 0.5), 1e5, 0.01)
    flat = jb.contact(MESH, TOP, jb.half_plane([0.0, 0.6], [0.0, -1.0]), 1e5, 0.01)
    scene = jb.command(scene_with(round_one, flat), [0.05, -0.1])
    (body,) = drawn(scene, fill="#DCE5EE")
    scale, corner = np.ptp(body[:, 0]) / 3.5, np.array([body[:, 0].min(), body[:, 1].max()])
    back = lambda lines: (np.concatenate(lines) - corner) / [scale, -scale] + [-1.75, -0.4]
    rims = paths(scene._repr_html_())
    rims = [back(lines) for found, lines in rims if found["stroke"] == RIGID and found["stroke-width"] == "2"]
    hatching = [
        back(lines)
        for found, lines in paths(scene._repr_html_())
        if (found["stroke"], found["stroke-width"]) == (RIGID, "0.8")
    ]
    assert len(rims) == len(hatching) == 2
    # The commands have moved them by 0.05 and -0.1 upward. A pixel is 0.01.
    np.testing.assert_allclose(np.linalg.norm(rims[0] - [0.5, -0.95], axis=1), 0.5, atol=0.01)
    np.testing.assert_allclose(rims[1][:, 1], 0.5, atol=0.01)
    assert np.linalg.norm(hatching[0] - [0.5, -0.95], axis=1).max() < 0.51 and hatching[1][:, 1].min() > 0.49


def test_supports_springs_and_lonely_nodes_are_dots():
    moved, tied = jb.support(MESH, RIGHT, y=1.0), jb.penalty_springs(MESH, TOP[:2], 1e3)
    assert len(drawn(scene_with(moved), stroke="white")) == len(RIGHT)
    assert len(drawn(scene_with(tied), stroke="white")) == 2
    pinned = jb.Scene(MESH, (BODY,), jb.clamped(MESH, [0, 12]))
    assert len(drawn(pinned, **{"stroke-width": "6"})) == 2


def test_several_bodies_and_holes():
    ring = annulus()
    scene = jb.Scene(ring, (jb.solid(ring, jb.lame(1.0, 0.3)),), jb.clamped(ring, [0]))
    assert len(drawn(scene, fill="#DCE5EE")) == 2
    two = jb.Mesh([[0, 0], [1, 0], [0, 1], [3, 0], [4, 0], [3, 1]], [[0, 1, 2], [3, 4, 5]])
    scene = jb.Scene(two, (jb.solid(two, jb.lame(1.0, 0.3)),), jb.clamped(two, [0, 1, 3, 4]))
    assert len(drawn(scene, fill="#DCE5EE")) == 2
    assert "2 x term (ground)" in repr(jb.Scene(two, (jb.Term(ground, [[2], [5]], jnp.ones(2)),), scene.fixed))


def ground(x, stiffness):
    return stiffness * jnp.sum(x**2)


def test_edges_are_joined():
    for mesh in (MESH, annulus(), jb.rod_beam().mesh):
        edges = outline(mesh)
        lines = chains(edges[np.random.default_rng(0).permutation(len(edges))])
        assert np.array_equal(np.sort(np.concatenate(lines)), np.arange(len(edges)))
    assert len(chains(jb.rod_beam().mesh.elements[::-1])) == 1
    assert chains(np.zeros((0, 2), int)) == []


def test_one_outline_for_meshes_that_differ_inside():
    one, other = (outline(jb.tendon_beam(5, 3, diagonals=kind).mesh) for kind in ("one-sided", "mirrored"))
    np.testing.assert_array_equal(one, other)


def test_a_picture_of_any_numbers():
    """Not finite, overflowing, tiny, one point, and none."""
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    with np.errstate(all="raise"):
        for factor in (1e308, -1e308, 1e-300, 1.0):
            assert "<path" in svg([Stroke([factor * square], "black")])
        assert f'height="{LOWEST}"' in svg([Stroke([np.zeros((1, 2))], "black")])
    assert svg([Stroke([np.full((3, 2), bad)], "black") for bad in (np.nan, np.inf)]) == ""
    assert svg([]) == ""


def test_scenes_that_are_no_body_show_text():
    """Gradients, stacks, other trees, traced and deleted scenes."""
    scene = small_beam()
    gradient = jax.grad(lambda scene: jb.energy(scene, 1.1 * scene.mesh.nodes))(scene)
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), scene, scene)
    lanes = jax.vmap(lambda ratios: jb.command(scene, ratios))(jnp.ones((2, 2)))
    empty = jax.tree.map(lambda leaf: None, scene)
    wild = jax.tree.map(lambda leaf: leaf * jnp.nan, scene)
    gone = jax.tree.map(lambda leaf: leaf + 0, scene)
    said = []
    jax.eval_shape(lambda scene: said.append((repr(scene), scene._repr_html_())), scene)
    for leaf in jax.tree.leaves(gone):
        leaf.delete()
    for each in (gradient, stack, lanes, empty, wild, gone):
        said.append((repr(each), each._repr_html_()))
        assert str(each)
    assert not any("<svg" in html for _, html in said)
    wanted = [
        "commands traced",
        "commands",
        "stack of scenes; 15 nodes",
        "stack of scenes; 15 nodes",
        "a tree of other",
        "commands [nan",
        "deleted",
    ]
    assert all(text in short and text in html for text, (short, html) in zip(wanted, said, strict=True))


def test_facts_in_lines():
    assert str(jb.command(small_beam(), [0.5, 1.0])) == (
        "Scene\n  3.5 x 0.8, 15 nodes, 16 triangles of 3 nodes, float64\n  16 x solid (counted), 2 x tendon\n"
        "  24 of 30 coordinates free\n  commands [0.5, 1]"
    )
    assert "commands" not in str(scene_with())
    many = jb.pulls(MESH, [[0, 7]] * 20)
    assert "[0, 0, 0, 0, 0, 0, 0, 0, ... 20 in all]" in repr(scene_with(many))
    assert "<lambda>" not in scene_with(jb.Term(lambda x, p: jnp.sum(p * x), [[3]], jnp.ones(1)))._repr_html_()


def test_names_of_users_are_escaped():
    scene = jb.Scene(MESH, (jb.Term(lambda x, p: jnp.sum(p * x), [[3]], jnp.ones(1)),), jb.clamped(MESH, LEFT))
    assert "1 x term (&lt;lambda&gt;)" in scene._repr_html_()


def test_user_settings_change_nothing():
    scene = jb.command(spring_pair(0.9), [0.9, 0.8])
    plain = scene._repr_html_()
    gradient = jax.grad(lambda scene: jb.energy(scene, 1.1 * scene.mesh.nodes))(small_beam())
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"), jax.debug_nans(True):
        assert scene._repr_html_() == plain
        assert "commands [-inf, -inf]" in repr(gradient) and "<svg" not in gradient._repr_html_()


def test_no_picture_needs_matplotlib():
    assert (
        run_python(
            "import sys, jaxbeam as jb; s = jb.tendon_beam(5, 3); assert '<svg' in s._repr_html_();"
            "assert '<svg' in jb.equilibrium(s)._repr_html_(); print('matplotlib' in sys.modules)"
        )
        == "False\n"
    )
