"""Fields in colour: at nodes and elements, in pictures that are moved and over several states."""

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import TriMesh
from matplotlib.figure import Figure
from pictures import BOUNDS, LENGTH, arrows, at, beam_mesh, frames_of, moved, scene_of
from quadrilateral import QUADRILATERAL, quadrilaterals

import jaxbeam as jb
from jaxbeam import plot
from jaxbeam.mesh import elements
from jaxbeam.mesh.surface import surface
from jaxbeam.plot.acting import ARROW


@pytest.fixture(scope="module")
def mesh():
    return beam_mesh()


@pytest.fixture
def square():
    """Quadrilaterals of nine nodes, which the package does not know otherwise."""
    elements.ELEMENTS[QUADRILATERAL.nodes] = QUADRILATERAL
    yield quadrilaterals(jb.rectangle(LENGTH, 1.0, 4, 3, order=2))
    del elements.ELEMENTS[QUADRILATERAL.nodes]


def smooth_of(ax):
    (found,) = (c for c in ax.collections if isinstance(c, TriMesh))
    return found


def linear(points):
    return 0.3 + np.asarray(points)[..., :2] @ np.array([2.0, -1.5])


@pytest.mark.parametrize("kind", ["three", "six", "nine"])
def test_a_smooth_field_has_a_linear_function_exactly(kind, square):
    """At every point that is drawn, on bent elements too: it is interpolated as positions are."""
    mesh = square if kind == "nine" else jb.rectangle(LENGTH, 1.0, 6, 3, order=1 if kind == "three" else 2)
    scene = jb.Scene(mesh, (jb.solid(mesh, jb.lame(1.0, 0.3)),), jb.clamped(mesh, [0, 1]))
    x = moved(mesh)
    picture = plot.Picture(scene, mesh.nodes, field=plot.Field(linear(mesh.nodes), "u"), bounds=BOUNDS)
    picture.move(x, values=linear(x))
    found = smooth_of(picture.ax)
    triangulation = found._triangulation
    points = np.stack([triangulation.x, triangulation.y], axis=1)
    np.testing.assert_allclose(found.get_array(), linear(points), atol=1e-12)
    # The triangles fill the body.
    a, b, c = points[triangulation.triangles].transpose(1, 0, 2)
    area = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum()
    edges = surface(mesh)
    along = x[edges[:, :2]] if kind == "three" else x[edges[:, [0, 2, 1]]]
    ring = along.reshape(-1, 2) if kind == "three" else np.concatenate([along[:, :2], along[:, 1:]]).reshape(-1, 2)
    starts, ends = ring[::2], ring[1::2]
    inside = 0.5 * np.sum(starts[:, 0] * ends[:, 1] - starts[:, 1] * ends[:, 0])
    np.testing.assert_allclose(area, inside, rtol=1e-12 if kind == "three" else 0.01)
    if kind != "three":  # the outer edges are curved
        assert len(found.get_array()) > 9 * len(mesh.elements)


def test_smooth_fields_hide_the_edges_of_elements_and_those_of_elements_do_not(mesh):
    scene = scene_of(mesh)
    ax = plot.field(scene, mesh.nodes, linear(mesh.nodes), "u")
    flat = [c for c in ax.collections if c.get_array() is not None and not isinstance(c, TriMesh)]
    assert smooth_of(ax).get_visible() and not any(c.get_visible() for c in flat)
    ax = plot.field(scene, mesh.nodes, np.arange(len(mesh.elements)), "u")
    assert not any(isinstance(c, TriMesh) for c in ax.collections)


def test_values_are_given_or_those_of_a_function(mesh):
    scene = scene_of(mesh, jb.pressure(mesh, np.unique(surface(mesh)[:, :2])))
    x = moved(mesh)
    of_elements = plot.Picture(scene, field=plot.Field(np.zeros(len(mesh.elements)), "u", colours=(0, 1)))
    values = np.linspace(0, 1, len(mesh.elements))
    of_elements.move(x, values=values)
    (body,) = (c for c in of_elements.ax.collections if c.get_array() is not None)
    np.testing.assert_array_equal(body.get_array(), values)
    counted = []

    def under(scene, x):
        counted.append(1)
        return x[:, 1] + jnp.sum(scene.terms[1].kind.command_of(scene.terms[1].params))

    of_function = plot.Picture(scene, field=plot.Field(under, "y"))
    for value in (2.0, 3.0):
        of_function.move(x, [value])
        np.testing.assert_allclose(smooth_of(of_function.ax).get_array(), (x[:, 1] + value)[mesh.elements].ravel())
    assert len(counted) == 1  # it is traced once


def test_a_mesh_with_as_many_nodes_as_elements_must_be_told(mesh):
    """Six nodes around one more, and six triangles and a seventh beside them."""
    around = [[np.cos(t), np.sin(t)] for t in np.pi / 3 * np.arange(6)]
    nodes = np.array([[0.0, 0.0], *around, [1.5, 0.9]])
    fan = [[0, 1 + k, 1 + (k + 1) % 6] for k in range(6)]
    even = jb.Mesh(nodes, np.array([*fan, [1, 7, 2], [2, 7, 3]]))
    assert len(even.nodes) == len(even.elements) == 8
    scene = jb.Scene(even, (jb.solid(even, jb.lame(1.0, 0.3)),), jb.clamped(even, [0]))
    values = np.arange(8.0)
    with pytest.raises(ValueError, match="at_nodes: the mesh has 8 nodes and as many elements; expected True or False"):
        plot.Picture(scene, field=plot.Field(values, "u"))
    ax = plot.Picture(scene, field=plot.Field(values, "u", at_nodes=True)).ax
    np.testing.assert_array_equal(smooth_of(ax).get_array(), values[even.elements].ravel())
    ax = plot.Picture(scene, field=plot.Field(values, "u", at_nodes=False)).ax
    (body,) = (c for c in ax.collections if c.get_array() is not None)
    np.testing.assert_array_equal(body.get_array(), values)


def test_wrong_positions_and_values_are_named(mesh):
    scene, count = scene_of(mesh), len(mesh.nodes)
    plain = plot.Picture(scene)
    with pytest.raises(ValueError, match=rf"x: expected node positions of shape \({count}, 2\), got \(3, 2\)"):
        plain.move(np.zeros((3, 2)))
    with pytest.raises(ValueError, match="x: some positions are not finite"):
        plain.move(np.full((count, 2), np.inf))
    with pytest.raises(ValueError, match=r"ratios: expected .*, got"):
        plain.move(mesh.nodes, [1.0])
    with pytest.raises(ValueError, match="values: expected none, because the picture has no field"):
        plain.move(mesh.nodes, values=np.zeros(count))
    given = plot.Picture(scene, field=plot.Field(np.zeros(count), "u"))
    with pytest.raises(ValueError, match="values: expected those of the field in this state, got none; give them"):
        given.move(mesh.nodes)
    with pytest.raises(ValueError, match=rf"values: expected shape \({count},\), one for each node, got \(3,\)"):
        given.move(mesh.nodes, values=np.zeros(3))
    with pytest.raises(ValueError, match="values: node 4 is not finite"):
        given.move(mesh.nodes, values=np.where(np.arange(count) == 4, np.nan, 0.0))
    function = plot.Picture(scene, field=plot.Field(lambda scene, x: x[:, 0], "u"))
    with pytest.raises(ValueError, match="values: expected none, because the picture has no field, or one of a func"):
        function.move(mesh.nodes, values=np.zeros(count))
    with pytest.raises(ValueError, match="values: expected shape"):
        plot.Picture(scene, field=plot.Field(lambda scene, x: x, "u"))
    with pytest.raises(ValueError, match="values: node 0 is not finite"):
        plot.Picture(scene, field=plot.Field(lambda scene, x: jnp.full(len(x), jnp.nan), "u"))


def test_values_of_the_other_place_are_refused_by_a_moved_picture(mesh):
    """A picture of values at nodes cannot show those of elements."""
    picture = plot.Picture(scene_of(mesh), field=plot.Field(np.zeros(len(mesh.nodes)), "u"))
    with pytest.raises(ValueError, match=r"values: expected shape \(27,\), one for each node, got \(32,\)"):
        picture.move(mesh.nodes, values=np.zeros(len(mesh.elements)))


# -------------------------------------------------------------------------------------- several states at once


def scales(axes):
    found = [c for ax in axes for c in ax.collections if c.get_array() is not None and c.get_visible()]
    return np.array([c.get_clim() for c in found]), {c.get_cmap().name for c in found}


@pytest.mark.parametrize("at_nodes", [True, False])
def test_panels_have_one_colour_scale(mesh, at_nodes):
    """From the 1st to the 99th percentile of the values of all states of all bodies."""
    scene = scene_of(mesh, jb.support(mesh, [at(mesh, 2.0, 0.5)], y=1.0))
    measure = lambda scene, x: x[:, 1] if at_nodes else x[scene.mesh.elements[:, 0], 1]
    x = np.stack([moved(mesh, far) for far in (0.0, 0.5, 1.0)])
    one = plot.States(scene, np.zeros((3, 1)), x)
    other = plot.States(scene, np.zeros((3, 1)), 2 * x)
    values = lambda states: states.x[:, :, 1] if at_nodes else states.x[:, mesh.elements[:, 0], 1]
    field = plot.Field(measure, "y", centre=0.0)

    figure = plot.gallery(one, field=field)
    limits, names = scales(figure.axes[:3])
    reach = np.abs(np.quantile(values(one), [0.01, 0.99])).max()
    np.testing.assert_allclose(limits, [[-reach, reach]] * 3, rtol=1e-12)
    assert names == {"RdBu_r"}
    assert [ax.get_xlabel() for ax in figure.axes].count("y") == 1

    both = np.concatenate([values(one).ravel(), values(other).ravel()])
    reach = np.abs(np.quantile(both, [0.01, 0.99])).max()
    for frame, axes in frames_of(plot.animate_beams([one, other], field=field)):
        np.testing.assert_allclose(scales(axes)[0], [[-reach, reach]] * 2, rtol=1e-12)
        for ax, states in zip(axes, (one, other), strict=True):
            (shown,) = (c for c in ax.collections if c.get_array() is not None and c.get_visible())
            expected = values(states)[frame]
            np.testing.assert_allclose(shown.get_array(), expected[mesh.elements].ravel() if at_nodes else expected)
    for frame, (ax,) in frames_of(plot.animate_ramp(one, field=field)):
        (shown,) = (c for c in ax.collections if c.get_array() is not None and c.get_visible())
        assert len(shown.get_array()) == values(one)[frame].size * (1 if not at_nodes else 96 / 27)


def test_several_states_need_a_function(mesh):
    scene = scene_of(mesh, jb.support(mesh, [at(mesh, 2.0, 0.5)], y=1.0))
    states = plot.States(scene, np.zeros((2, 1)), np.stack([mesh.nodes] * 2))
    field = plot.Field(np.zeros(len(mesh.nodes)), "u")
    for draw in (plot.gallery, plot.animate_ramp, lambda states, field: plot.animate_beams([states], field=field)):
        with pytest.raises(ValueError, match=r"field: expected a Field of a function \(scene, x\)"):
            draw(states, field=field)


def test_a_picture_draws_into_given_axes_and_has_a_colour_bar(mesh):
    ax = Figure().add_subplot()
    picture = plot.Picture(scene_of(mesh), field=plot.Field(linear(mesh.nodes), "u (units)"), ax=ax)
    assert picture.ax is ax and not ax.figure.legends
    assert [child.get_ylabel() for child in ax.child_axes] == ["u (units)"]
    load = jb.dead_load(mesh, [at(mesh, 2.0, 0.5)], [0.0, -1.0])
    own = plot.Picture(scene_of(mesh, load))
    np.testing.assert_allclose(np.diff(arrows(own.ax), axis=0).ravel(), [0.0, -ARROW * LENGTH], atol=1e-12)


def test_a_colour_bar_of_flat_panels_has_room_for_its_label(mesh):
    """It lies below them, within the figure."""
    scene = scene_of(mesh, jb.support(mesh, [at(mesh, 2.0, 0.5)], y=1.0))
    states = plot.States(scene, np.zeros((3, 1)), np.stack([mesh.nodes] * 3))
    field = plot.Field(lambda scene, x: x[:, 0], "a quantity with a long name (unit of force / unit of area)")
    for figure in (plot.gallery(states, field=field), plot.animate_ramp(states, field=field)._fig):
        figure.draw_without_rendering()
        (bar,) = (ax for ax in figure.axes if "quantity" in ax.get_xlabel())
        beam = next(ax for ax in figure.axes if ax.get_aspect() == 1)
        assert bar.get_position().y1 < beam.get_position().y0
        label = bar.xaxis.label.get_window_extent()
        assert label.x0 > 0 and label.x1 < figure.bbox.x1 and label.y0 > 0
