"""Scenes of one small beam with something that acts on it, and what a picture of them holds."""

import numpy as np
from matplotlib.collections import PolyCollection

import jaxbeam as jb

LENGTH, HEIGHT = 4.0, 1.0
BOUNDS = ((-4.0, 4.0), (-4.0, 4.0))


def beam_mesh():
    return jb.rectangle(LENGTH, HEIGHT, 9, 3)


def scene_of(mesh, *terms):
    left = jb.nodes_where(mesh, lambda x, y: x < -LENGTH / 2 + 1e-9)
    tip = jb.nodes_where(mesh, lambda x, y: x > LENGTH / 2 - 1e-9)
    return jb.Scene(mesh, (jb.solid(mesh, jb.lame(1.0, 0.3)), *terms), jb.clamped(mesh, left), tip)


def moved(mesh, far=1.0):
    """A bend of the body."""
    nodes = np.asarray(mesh.nodes)
    across = -0.05 * far * (nodes[:, 0] + 2) ** 2
    return np.stack([nodes[:, 0] + 0.1 * far * (nodes[:, 0] + 2) * nodes[:, 1], nodes[:, 1] + across], axis=1)


def at(mesh, x, y):
    """The number of the node at a place."""
    (found,) = jb.nodes_where(mesh, lambda a, b: (abs(a - x) < 1e-9) & (abs(b - y) < 1e-9))
    return int(found)


def upper(mesh):
    return jb.nodes_where(mesh, lambda x, y: y > HEIGHT / 2 - 1e-9)


def arrows(ax, row=False):
    """Tails and heads `(q, 2)` of the arrows of forces, or of rows."""
    (heads,) = (c for c in ax.collections if c.get_zorder() == 8.1 and c.axes and is_row(ax, c) == row)
    shafts = ax.collections[list(ax.collections).index(heads) - 1]
    assert shafts.get_zorder() == 8
    tips = [path.vertices[0] for path in heads.get_paths()]
    return np.array([s[0] for s in shafts.get_segments()]).reshape(-1, 2), np.array(tips).reshape(-1, 2)


def is_row(ax, heads):
    shafts = ax.collections[list(ax.collections).index(heads) - 1]
    return float(shafts.get_linewidths()[0]) < 1


def triangles(ax):
    """Tips `(q, 2)` of the triangles at supported nodes, and the directions `(q, 2)` from there to the ground."""
    (found,) = (c for c in ax.collections if c.get_zorder() == 7 and isinstance(c, PolyCollection))
    corners = np.array([path.vertices[:3] for path in found.get_paths()])
    away = corners[:, 1:].mean(axis=1) - corners[:, 0]
    return corners[:, 0], away / np.linalg.norm(away, axis=1, keepdims=True)


def legend(ax):
    return [text.get_text() for text in ax.figure.legends[0].get_texts()]


def inside(points, ax):
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    x, y = np.asarray(points).reshape(-1, 2).T
    return (x0 < x).all() and (x < x1).all() and (y0 < y).all() and (y < y1).all()


def frames_of(animation):
    """The panels with beams, frame by frame, as the animation is drawn."""
    animation._draw_was_started = True  # it is not saved here, and matplotlib warns of that
    for frame in animation.new_frame_seq():
        animation._draw_frame(frame)
        yield frame, [ax for ax in animation._fig.axes if ax.get_aspect() == 1]
