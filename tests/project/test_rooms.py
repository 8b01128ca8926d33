"""The rooms of the package stand one above the other, and `jaxbeam` shows its public names alone."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path
from types import ModuleType

import pytest

import jaxbeam as jb

PACKAGE = Path(jb.__file__).parent

# Each room, and those that it may import from.
BELOW = {
    "core": set(),
    "mesh": {"core"},
    "physics": {"core", "mesh"},
    "scene": {"core", "mesh", "physics"},
    "linear": {"core"},
    "solve": {"core", "mesh", "physics", "scene", "linear"},
    "study": {"core", "mesh", "physics", "scene", "linear", "solve"},
    "plot": {"core", "mesh", "physics", "scene", "linear", "solve", "study"},
    "files": {"core", "mesh", "physics", "scene", "linear", "solve"},
}


def module_name(path):
    """`jaxbeam.room.file`; of an `__init__.py` the folder's name."""
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


FILES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def imported(path):
    """Modules of the package that a file imports, wherever in it the import stands."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}, line {node.lineno}: write the whole name of the module"
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            # `from package import module` imports the module, else names of the module.
            found |= {name if name in FILES else node.module for name in names}
    return {name for name in found if name.partition(".")[0] == "jaxbeam"}


IMPORTS = {name: imported(path) for name, path in FILES.items()}


def room(module):
    """The room of a module; of `jaxbeam` itself, which gathers the public names of all, the empty name."""
    return module.split(".")[1] if "." in module else ""


def test_each_folder_is_a_room():
    assert {room(module) for module in FILES} - {"", "__main__"} == set(BELOW)


@pytest.mark.parametrize("name", BELOW)
def test_a_room_imports_from_rooms_below(name):
    upwards = [
        f"{module} imports {other}"
        for module, others in IMPORTS.items()
        if room(module) == name
        for other in sorted(others)
        if room(other) not in BELOW[name] | {name}
    ]
    assert not upwards


def test_pictures_and_files_are_imported_by_name_alone():
    """Matplotlib and meshio are needed by nothing else."""
    assert not {"plot", "files"} & {room(module) for module in IMPORTS["jaxbeam"]}


def test_no_import_is_cyclic():
    TopologicalSorter(IMPORTS).prepare()


def test_dir_shows_public_names_alone():
    tree = ast.parse(FILES["jaxbeam"].read_text())
    aliases = [alias for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names]
    gathered = {alias.asname or alias.name for alias in aliases}
    assert set(dir(jb)) == set(jb.__all__) == {name for name in gathered if not name.startswith("_")}
    for name in dir(jb):
        value = getattr(jb, name)
        assert not isinstance(value, ModuleType)
        assert value.__module__.startswith("jaxbeam.")
