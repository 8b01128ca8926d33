"""What every benchmark prints: the machine and versions, and tables."""

from __future__ import annotations

import argparse
import os
import platform
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np

PACKAGES = ("jaxbeam", "jax", "jaxlib", "numpy", "scipy", "simkit", "felupe")


def options(description: str | None) -> argparse.ArgumentParser:
    """A parser of the command line that shows the first line of a module's description."""
    return argparse.ArgumentParser(description=(description or "").partition("\n")[0])


def machine() -> dict[str, str]:
    """What the figures depend on."""
    return {
        "processor": processor(),
        "cores": str(os.cpu_count()),
        "threads": threads(),
        "device": jax.devices()[0].device_kind,
        "dtype": str(np.zeros(()).dtype if jax.config.jax_enable_x64 else np.zeros((), np.float32).dtype),
        "python": platform.python_version(),
        **{name: version(name) for name in PACKAGES},
    }


def processor() -> str:
    """The model's name."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    found = {line.partition(":")[0].strip(): line.partition(":")[2].strip() for line in reversed(lines)}
    numbers = f"family {found.get('cpu family')} model {found.get('model')}" if found else ""
    return f"{found.get('model name', platform.processor())} {numbers}".strip()


def threads() -> str:
    """How many threads libraries may use."""
    one = all(os.environ.get(name) == "1" for name in ("OPENBLAS_NUM_THREADS", "NPROC"))
    return "1" if one else f"up to {len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else '?'}"


def version(package: str) -> str:
    """The installed version of a package."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "absent"


def head(title: str) -> None:
    """Print a title and what the figures depend on."""
    print(f"\n== {title}\n" + ", ".join(f"{name} {value}" for name, value in machine().items()), flush=True)


def table(header: tuple[str, ...], rows: list[tuple[Any, ...]]) -> None:
    """Print a table; numbers with four digits, right-aligned."""
    cells = [header, *(tuple(_cell(value) for value in row) for row in rows)]
    widths = [max(len(row[k]) for row in cells) for k in range(len(header))]
    for row in cells:
        first, *others = (text.rjust(w) for text, w in zip(row, widths, strict=True))
        print("  ".join([first.strip().ljust(widths[0]), *others]))
    print(flush=True)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float | np.floating) else str(value)
