"""Importing this first, before NumPy and JAX, keeps everything that a benchmark times to one thread.

The matrices of one scene are too small for more, and a ratio of two libraries says most when both have one core.
`cleared` gives a new process the machine as a user meets it.
"""

from __future__ import annotations

import os

SETTINGS = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    # XLA's own pool: it does not heed --xla_cpu_multi_thread_eigen=false in every product.
    "NPROC": "1",
}
added = {name: value for name, value in SETTINGS.items() if name not in os.environ}
os.environ.update(added)


def cleared() -> dict[str, str]:
    """The environment without these settings."""
    return {name: value for name, value in os.environ.items() if name not in added}
