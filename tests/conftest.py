"""Settings and scenes that the tests share. Each new scene shape compiles for seconds, so few shapes are used."""

import gc
import os
from pathlib import Path
from types import SimpleNamespace

# Before JAX is imported: both processes of the tests, and the scripts they start, compile each program once.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "jax"))
# Its matrices are too small for more, and on a busy machine threads wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")

import jax
import pytest
from helpers import Terminal

import jaxbeam as jb
from jaxbeam.core.compiling import COMPILER_OPTIONS

# Nearly all of the time here is compilation: what the library asks for its own programs is asked for all others as
# well, and LLVM optimises none, in one piece: the other core has tests of its own. XLA reads it when the first one is
# compiled. Benchmarks verify what is optimised.
options = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
    "xla_cpu_parallel_codegen_split_count": 1,
    **(COMPILER_OPTIONS or {}),
}
os.environ["XLA_FLAGS"] = " ".join(
    [os.environ.get("XLA_FLAGS", ""), *(f"--{name}={str(value).lower()}" for name, value in options.items())]
)

jax.config.update("jax_enable_x64", True)

# Python's search for reference cycles takes a tenth of the time of tracing. What is loaded now stays anyway.
gc.freeze()
gc.set_threshold(100_000, 50, 1000)


@pytest.fixture
def terminal(monkeypatch):
    """Stderr as a terminal; `getvalue()` is what was written to it."""
    stream = Terminal()
    # Not `sys.stderr` itself: pytest sets that anew before each test.
    monkeypatch.setattr("jaxbeam.core.progress.sys", SimpleNamespace(stderr=stream))
    return stream


@pytest.fixture(scope="session")
def beam():
    """The reference scene, at its natural lengths."""
    return jb.tendon_beam()


@pytest.fixture(scope="session")
def mirrored():
    """The reference scene on a mesh that is symmetric about mid-height; same shape as `beam`."""
    return jb.tendon_beam(diagonals="mirrored")


@pytest.fixture(scope="session")
def steered(beam):
    """The reference scene commanded to (0.4, 1.0), and its equilibrium by one jump from rest."""
    scene = jb.command(beam, [0.4, 1.0])
    return scene, jb.equilibrium(scene)


@pytest.fixture(scope="session")
def bent_path(beam):
    """The reference ramp of 28 steps to (0.4, 1.0)."""
    return jb.ramp(beam, [0.4, 1.0], steps=28)


@pytest.fixture(scope="session")
def folded_path(beam):
    """The reference ramp of 28 steps with both tendons to 0.4, which passes a fold."""
    return jb.ramp(beam, [0.4, 0.4], steps=28)
