"""What is read of a Gmsh file beside meshio: whether its counts fit it, and the names of its physical groups.

meshio makes arrays as long as the counts and the largest node tag of the file say. One damaged byte in them would take
all memory of the machine, so they are looked at first. The format is described in the reference manual of Gmsh, "Gmsh
file formats".
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

# Nodes of each type of element that is read: lines, triangles, points. Others are refused later.
_NODES = {1: 2, 2: 3, 8: 3, 9: 6, 15: 1}


def is_gmsh(file: Path) -> bool:
    """Whether it is a file of Gmsh. Those of ANSYS have the same suffix, and do not begin with a dollar sign."""
    with open(file, "rb") as stream:
        return file.suffix.lower() == ".msh" and stream.read(1) == b"$"


def physical_names(file: Path) -> dict[tuple[int, int], str]:
    """Names of the physical groups of a Gmsh file, by dimension and number. They are text, also in a binary file."""
    if not is_gmsh(file):
        return {}
    section = re.search(rb"\$PhysicalNames\s+(.*?)\$EndPhysicalNames", file.read_bytes(), re.DOTALL)
    text = section[1].decode(errors="replace") if section else ""
    return {(int(d), int(tag)): name for d, tag, name in re.findall(r'^\s*(\d+)\s+(\d+)\s+"(.*)"\s*$', text, re.M)}


def check_counts(file: Path) -> None:
    """Raise `ValueError` if counts or node tags are far larger than the file. Formats 2.2 and 4.1 are looked at."""
    data = file.read_bytes()
    head = re.match(rb"\$MeshFormat\s+(2|2\.2|4|4\.1)\s+([01])\s+([48])\s", data)
    if not head:
        return
    # Tags may have gaps, but a file that needs an array of more entries than this is not one of a mesh generator.
    limit = max(10**7, 4 * len(data))
    version, binary, size = head[1][:1], head[2] == b"1", np.dtype(f"u{head[3].decode()}")
    numbers = {name: _Numbers(data, name, binary, limit) for name in (b"Nodes", b"Elements")}
    if version == b"4":
        _walk_nodes(numbers[b"Nodes"], size)
        _walk_elements(numbers[b"Elements"], size)
    elif not binary:
        # Tag, x, y and z of each node. Binary files of this format have tags without gaps, which meshio checks.
        count = numbers[b"Nodes"].count(np.dtype("i4"))
        numbers[b"Nodes"].bounded(numbers[b"Nodes"].take(np.dtype("f8"), 4 * count)[::4])


def _walk_nodes(numbers: _Numbers, size: np.dtype) -> None:
    blocks, _ = numbers.count(size), numbers.count(size)
    numbers.take(size, 2)
    for _ in range(blocks):
        numbers.take(np.dtype("i4"), 3)
        count = numbers.count(size)
        numbers.bounded(numbers.take(size, count))
        numbers.take(np.dtype("f8"), 3 * count)


def _walk_elements(numbers: _Numbers, size: np.dtype) -> None:
    blocks = numbers.count(size)
    numbers.take(size, 3)
    for _ in range(blocks):
        kind = int(numbers.take(np.dtype("i4"), 3)[2])
        count = numbers.count(size)
        if kind not in _NODES:
            return
        numbers.take(size, count * (1 + _NODES[kind]))


class _Numbers:
    """The numbers of a section, taken one after the other.

    data: bytes of the file.
    name: name of the section.
    binary: whether numbers are binary, or else text.
    limit: the largest count and tag.
    """

    def __init__(self, data: bytes, name: bytes, binary: bool, limit: int) -> None:
        found = re.search(rb"\$" + name + rb"[ \t\r]*\n", data)
        start = found.end() if found else len(data)
        self.binary, self.limit, self.place = binary, limit, 0
        self.values: Any = data[start:]
        if not binary:
            end = data.find(b"$End" + name, start)
            words = data[start : end if end >= 0 else len(data)].split()
            self.values = np.array(words, dtype=np.float64)

    def take(self, dtype: np.dtype, count: int) -> Any:
        """The next `count` numbers."""
        start, self.place = self.place, self.place + count * (dtype.itemsize if self.binary else 1)
        if self.place > len(self.values):
            raise ValueError("a section is shorter than its counts say")
        return np.frombuffer(self.values[start : self.place], dtype) if self.binary else self.values[start : self.place]

    def count(self, dtype: np.dtype) -> int:
        """The next number, which is a count."""
        return int(self.bounded(self.take(dtype, 1))[0])

    def bounded(self, numbers: Any) -> Any:
        """Numbers that must not be negative or larger than the limit."""
        if numbers.size and not (numbers.min() >= 0 and numbers.max() <= self.limit):
            raise ValueError(f"a count or tag is {numbers.max():.0f}, more than the file can hold")
        return numbers
