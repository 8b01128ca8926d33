"""One file that holds a scene and its solution, to the last bit.

It is an `.npz` of NumPy: an entry for each array, and the entry `header`, the bytes of a JSON text with the name and
version of the format, the version of jaxbeam, and the trees of scene and solution. Functions are stored by their names.
The outline of the solution is an entry of its own, which archives of the same version need not have.
The comment at the end of the zip file is a SHA-256 checksum of all bytes before it.

Loading imports modules of jaxbeam alone, and those that the caller trusts. The checksum finds damage, not malice: load
files from a source that you trust.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import struct
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np

from jaxbeam.core import checks
from jaxbeam.files import disk
from jaxbeam.files.names import OWN, trusted_names
from jaxbeam.files.states import check_solution
from jaxbeam.files.trees import decode, encode
from jaxbeam.scene.scene import Scene
from jaxbeam.solve.solution import Solution

FORMAT = "jaxbeam archive"
# Raise it when an older jaxbeam could not read what is written.
VERSION = 1
_LABEL = b"jaxbeam archive, sha256 "
_DIGITS = 64


def save(path: disk.PathLike, scene: Scene, solution: Solution | None = None) -> None:
    """Save a scene, and a solution of it, in one file (see `jaxbeam.files.archive`).

    The file is written beside `path` and then put in its place, so that an earlier one stays whole if the process is
    killed.

    Args:
        path: the file, by any name. One that is there is replaced.
        scene: its densities, stiffness laws, energies and obstacles must be functions and classes that can be imported.
        solution: from `equilibrium`, `ramp` or `sweep`.

    Raises:
        ValueError: if the folder is missing, the solution is not one of the scene, a value is traced, or the scene
            holds a function without a name, such as a lambda, or an object that is no dataclass.
    """
    file = disk.target(path)
    checks.instance("scene", scene, Scene, "make one with tendon_beam(), rod_beam() or Scene(mesh, terms, fixed, tip)")
    arrays: list[np.ndarray] = []
    header: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "jaxbeam": importlib.import_module(OWN).__version__,
        "scene": encode(scene, "scene", arrays),
        "solution": encode(solution, "solution", arrays),
    }
    if solution is not None:
        check_solution(scene, solution)
        header["outline"] = header["solution"]["fields"].pop("outline")
    text = np.frombuffer(json.dumps(header).encode(), np.uint8)
    with disk.whole(file) as temporary, open(temporary, "w+b") as stream:
        # NumPy writes one array after the other.
        np.savez(stream, header=text, **{f"array_{k}": array for k, array in enumerate(arrays)})  # type: ignore[arg-type]
        _seal(stream)


def load(path: disk.PathLike, trust: tuple[str, ...] = ()) -> tuple[Scene, Solution | None]:
    """Load what `save` wrote: the same arrays, dtypes, functions and structure, to the last bit.

    Args:
        path: the file.
        trust: names of modules, beside those of jaxbeam, that may be imported for functions and classes of your own,
            with the modules inside them. Importing a module runs it.

    Returns:
        The scene and the solution; None in its place if none was saved.

    Raises:
        ValueError: if there is no such file, it is damaged, of another kind or of a later version of the format, or it
            needs a module that is not trusted, or float64 where JAX has it switched off.
    """
    trusted = trusted_names(trust)
    file = disk.source(path)
    with open(file, "rb") as stream:
        _check_seal(file, stream)
        try:
            # No pickle is ever loaded.
            with np.load(stream, allow_pickle=False) as entries:
                header = json.loads(bytes(entries["header"]))
                arrays = [entries[f"array_{k}"] for k in range(len(entries.files) - 1)]
        except (zipfile.BadZipFile, KeyError, ValueError, EOFError, OSError) as error:
            raise _foreign(file) from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise _foreign(file)
    if not isinstance(header.get("version"), int) or header["version"] > VERSION:
        raise ValueError(
            f"path: {file.name} has version {header.get('version')} of the format, written by jaxbeam "
            f"{header.get('jaxbeam')}; this one reads up to {VERSION}, so install that version or a later one"
        )
    try:
        if header["solution"] is not None:
            header["solution"]["fields"]["outline"] = header.get("outline")
        scene, solution = (decode(header[name], arrays, trusted) for name in ("scene", "solution"))
    except (KeyError, IndexError, TypeError, AttributeError) as error:
        raise _foreign(file) from error
    if not isinstance(scene, Scene) or not isinstance(solution, Solution | None):
        raise _foreign(file)
    return scene, solution


# ------------------------------------------------------------------------------------------------ checksum


def _seal(stream: IO[bytes]) -> None:
    """Append the comment of the zip file: the label, and the checksum of all before the checksum."""
    stream.seek(-2, os.SEEK_END)
    # Until here the comment had the length 0.
    stream.write(struct.pack("<H", len(_LABEL) + _DIGITS) + _LABEL)
    stream.write(_digest(stream, stream.tell()))


def _check_seal(file: Path, stream: IO[bytes]) -> None:
    """Refuse a file whose checksum is missing or wrong."""
    end = stream.seek(0, os.SEEK_END) - _DIGITS
    stream.seek(max(end - len(_LABEL), 0))
    if stream.read(len(_LABEL)) != _LABEL:
        stream.seek(0)
        start = stream.read(2)
        raise _cut(file) if start == b"PK" else _foreign(file)
    written = stream.read()
    if written != _digest(stream, end):
        raise ValueError(
            f"path: {file.name} is damaged, its checksum is not that of its content; take another copy, or "
            f"save it again"
        )
    stream.seek(0)


def _digest(stream: IO[bytes], length: int) -> bytes:
    """SHA-256 of the first `length` bytes, in hexadecimal digits. The stream is left at their end."""
    stream.seek(0)
    sha = hashlib.sha256()
    while length:
        block = stream.read(min(length, 1 << 20))
        sha.update(block)
        length -= len(block)
    return sha.hexdigest().encode()


def _cut(file: Path) -> ValueError:
    return ValueError(
        f"path: {file.name} ends without the checksum of an archive of jaxbeam: it was cut short, damaged at its end, "
        f"or is another zip file; take another copy, or write it with files.save"
    )


def _foreign(file: Path) -> ValueError:
    return ValueError(f"path: {file.name} is no archive of jaxbeam; give a file that files.save wrote")
