"""The kinds of elements that a mesh may be made of. A new kind is one more entry."""

from __future__ import annotations

from typing import Any

from jaxbeam.mesh.element import Element
from jaxbeam.mesh.triangle import QUADRATIC_TRIANGLE, TRIANGLE

# Each kind by its number of nodes.
ELEMENTS = {element.nodes: element for element in (TRIANGLE, QUADRATIC_TRIANGLE)}


def element_of(elements: Any) -> Element:
    """The kind of elements with node numbers `elements` `(t, k)`. Any array with `k` entries on axis 1 will do."""
    return ELEMENTS[elements.shape[1]]
