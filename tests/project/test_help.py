"""What a user reads first: the map of names in `help(jaxbeam)`, and the questions that the examples answer."""

import ast
import importlib
import re
from pathlib import Path

import pytest

import jaxbeam as jb

EXAMPLES = Path(__file__).parents[2] / "examples"
# A line of the map: a name, and a few words from column 29 on.
ENTRY = re.compile(r"  (\S+) +(\S.*)")


def entries():
    """Names and words of the map."""
    lines = [line for line in jb.__doc__.splitlines() if re.match(r"  \S", line)]
    return [ENTRY.fullmatch(line).groups() for line in lines]


def test_the_map_holds_each_public_name_once():
    names = [name for name, _ in entries() if not name.startswith("jaxbeam.")]
    assert sorted(names) == jb.__all__


def test_the_map_names_the_rooms_that_are_imported_by_name():
    modules = [name for name, _ in entries() if name.startswith("jaxbeam.")]
    assert modules == ["jaxbeam.plot", "jaxbeam.files"]
    assert all(importlib.import_module(name).__doc__ for name in modules)


def test_the_map_is_aligned_and_narrow():
    """`help` indents it by four."""
    map_lines = [line for line in jb.__doc__.splitlines() if re.match(r"  \S", line)]
    assert all(len(line) + 4 < 100 for line in map_lines)
    assert {line.index(words) for line, (_, words) in zip(map_lines, entries(), strict=True)} == {28}


def test_each_entry_stands_under_a_heading():
    """The map comes in groups: a heading, entries, an empty line."""
    groups = [group.splitlines() for group in jb.__doc__.split("\n\n") if re.search(r"^  \S", group, re.MULTILINE)]
    assert len(groups) > 5
    for heading, *names in groups:
        assert re.match(r"\w", heading) and names
        assert all(ENTRY.fullmatch(name) for name in names)


def test_the_lines_of_code_give_the_reference_angle():
    code = "\n".join(line.strip() for line in jb.__doc__.splitlines() if line.startswith("    "))
    found = {"jb": jb}
    exec(code, found)
    assert float(found["angle"]) == pytest.approx(35.5152802, abs=1e-6)


def test_quoted_names_in_the_map_exist():
    for _, words in entries():
        for name in re.findall(r"`(\w+)`", words):
            assert name in jb.__all__


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_each_example_begins_with_its_question(path):
    question, *_ = ast.get_docstring(ast.parse(path.read_text())).splitlines()
    assert re.fullmatch(r"[A-Z].*\?", question)


def test_the_gallery_lists_each_example_by_its_question():
    """In order, with the first line of its docstring and its picture."""
    gallery = (EXAMPLES / "README.md").read_text()
    rows = re.findall(r"^\| !\[\]\((.+?)\) \| \[`(.+?)`\]\((.+?)\): \*\*(.+?)\*\* ", gallery, re.MULTILINE)
    paths = sorted(EXAMPLES.glob("*.py"))
    assert [file for _, file, _, _ in rows] == [link for _, _, link, _ in rows] == [path.name for path in paths]
    for (picture, _, _, question), path in zip(rows, paths, strict=True):
        assert (EXAMPLES / picture).stat().st_size > 10_000
        assert ast.get_docstring(ast.parse(path.read_text())).splitlines()[0] == question
