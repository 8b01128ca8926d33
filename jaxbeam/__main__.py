"""`python -m jaxbeam`: a window on the reference scene, to pull its tendons and drag its tip."""

from __future__ import annotations

import argparse

import jax
import matplotlib

from jaxbeam import plot
from jaxbeam.scene.beams import tendon_beam


def main() -> None:
    """Open the window."""
    parser = argparse.ArgumentParser(prog="python -m jaxbeam", description=__doc__)
    parser.add_argument("--bounds", nargs=2, type=float, default=(0.4, 1.0), metavar=("LOW", "HIGH"), help="of ratios")
    parser.add_argument("--browser", action="store_true", help="open in a browser (needs tornado)")
    arguments = parser.parse_args()
    if arguments.browser:
        matplotlib.use("webagg")
    jax.config.update("jax_enable_x64", True)
    try:
        plot.interact(tendon_beam(), bounds=tuple(arguments.bounds))
    except ValueError as error:
        parser.error(f"{error}; here: --browser" if not arguments.browser else str(error))
    except ImportError:
        parser.error("--browser needs tornado: pip install tornado")


if __name__ == "__main__":
    main()
