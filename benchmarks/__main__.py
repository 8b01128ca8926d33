"""Run the benchmarks, each in a process of its own: all, or those named.

    python -m benchmarks [NAME ...]

Each prints its tables. `python -m benchmarks.NAME --help` tells what one measures, and its options. Peers are installed
by `pip install -e '.[bench]'`.
"""

from __future__ import annotations

import argparse
import subprocess
import sys

NAMES = ("single", "many", "peers", "accuracy", "error_bars", "verification", "window", "fitting")
# It takes an hour, the others minutes each.
BY_NAME = ("extremes",)


def main() -> int:
    """The number of benchmarks that failed."""
    known = (*NAMES, *BY_NAME)
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(known)}; by default all but extremes")
    names = parser.parse_args().names
    unknown = sorted(set(names) - set(known))
    if unknown:
        parser.error(f"no benchmark is called {', '.join(unknown)}; there are {', '.join(known)}")
    failed = []
    for name in names or NAMES:
        command = [sys.executable, "-m", f"benchmarks.{name}"]
        print(f"\n$ python {' '.join(command[1:])}", flush=True)
        if subprocess.run(command).returncode:
            failed.append(name)
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return len(failed)


if __name__ == "__main__":
    sys.exit(main())
