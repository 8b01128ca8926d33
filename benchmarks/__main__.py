"""Run the benchmarks, each in a process of its own: all, or those named.

    python -m benchmarks [NAME ...] [--out out/benchmarks]

Each prints its tables and writes a JSON file and its plots into the folder. `python -m benchmarks.NAME --help` tells
what one measures. Peers are installed by `pip install -e '.[bench]'`.
"""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys
from pathlib import Path

# In the order of what they take: minutes each, an hour for `extremes`, which is run by name.
NAMES = ("single", "many", "floor", "scaling", "sparse", "simkit_peer", "accuracy", "error_bars")
# These print alone.
PRINTING = ("gradient", "precision", "verification")
BY_NAME = ("extremes",)


def main() -> int:
    """The number of benchmarks that failed."""
    known = [name for name in (*NAMES, *PRINTING, *BY_NAME) if importlib.util.find_spec(f"benchmarks.{name}")]
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(known)}; by default all but extremes")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"), help="folder for JSON files and plots")
    options = parser.parse_args()
    unknown = sorted(set(options.names) - set(known))
    if unknown:
        parser.error(f"no benchmark is called {', '.join(unknown)}; there are {', '.join(known)}")
    failed = []
    for name in options.names or [name for name in known if name not in BY_NAME]:
        command = [sys.executable, "-m", f"benchmarks.{name}"]
        if name not in PRINTING:
            command += ["--out", str(options.out)]
        print(f"\n$ python {' '.join(command[1:])}", flush=True)
        if subprocess.run(command).returncode:
            failed.append(name)
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return len(failed)


if __name__ == "__main__":
    sys.exit(main())
