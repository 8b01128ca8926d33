"""Paths of files to read and to write, and the import of meshio."""

from __future__ import annotations

import contextlib
import importlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeAlias

PathLike: TypeAlias = str | os.PathLike[str]


def meshio() -> Any:
    """The module meshio.

    Raises:
        ImportError: if it is not installed.
    """
    try:
        return importlib.import_module("meshio")
    except ImportError as error:
        raise ImportError(
            "reading meshes and writing VTU files needs meshio; install it with pip install 'jaxbeam[files]'"
        ) from error


def source(path: PathLike) -> Path:
    """Check the path of a file to read, which is there and not empty."""
    file = _path(path)
    if file.is_dir():
        raise ValueError(f"path: expected a file, got the folder {file}; name a file in it")
    if not file.exists():
        raise ValueError(f"path: there is no file {file}; check its name and the folder that it is looked for in")
    if file.stat().st_size == 0:
        raise ValueError(f"path: the file {file} is empty; write it again")
    return file


def target(path: PathLike, suffix: str | None = None) -> Path:
    """Check the path of a file to write, in a folder that is there. It ends in `suffix`, if one is given."""
    file = _path(path)
    if file.is_dir():
        raise ValueError(f"path: expected the name of a file, got the folder {file}; name a file in it")
    if suffix is not None and file.suffix != suffix:
        raise ValueError(f"path: expected a name that ends in {suffix}, got {file.name}; rename it")
    if not file.parent.is_dir():
        raise ValueError(f"path: there is no folder {file.parent} to write {file.name} into; make it first")
    # Of a link, the file that it points to is written.
    return file.resolve()


@contextlib.contextmanager
def whole(file: Path) -> Iterator[Path]:
    """A temporary path beside `file`. What is written there takes the place of `file` at the end, in one step.

    If writing fails, `file` stays as it was. A killed process leaves the temporary file behind.
    """
    temporary = file.with_name(f".{file.name}.{secrets.token_hex(4)}.tmp")
    try:
        yield temporary
        # The content must be on the disk before the name is, or a power cut could leave an empty file of that name.
        with open(temporary, "rb+") as stream:
            os.fsync(stream.fileno())
        os.replace(temporary, file)
    finally:
        temporary.unlink(missing_ok=True)


def _path(path: PathLike) -> Path:
    if not isinstance(path, str | os.PathLike) or path == "":
        raise ValueError(f"path: expected the name of a file, got {path!r}")
    return Path(path)
