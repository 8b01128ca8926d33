"""The kinds of elements that a mesh may be made of. A new kind is one more entry."""

from __future__ import annotations

from typing import Any

from jaxbeam.mesh.element import Element
from jaxbeam.mesh.triangle import QUADRATIC_TRIANGLE, TRIANGLE

# By their number of nodes.
ELEMENTS = {element.nodes: element for element in (TRIANGLE, QUADRATIC_TRIANGLE)}


def element_of(elements: Any) -> Element:
    """The kind of elements whose node numbers `(t, k)` these are."""
    return ELEMENTS[elements.shape[1]]
