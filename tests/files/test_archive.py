"""An archive gives back what was saved to the last bit, or says why it cannot."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import solution_of

import jaxbeam as jb
from jaxbeam import files
from jaxbeam.core.tree import replace
from jaxbeam.files import archive, names
from jaxbeam.scene.scene import commands_of
from jaxbeam.solve.solution import outlined

ROOT = Path(__file__).parents[2]


def beam():
    return jb.tendon_beam(nx=5, ny=3)


def with_everything():
    """Terms of most kinds on six-node triangles."""
    mesh = jb.rectangle(3.0, 0.8, 7, 3, order=2)
    x, y = np.asarray(mesh.nodes).T
    top, bottom = (np.flatnonzero(np.abs(y - side) < 1e-9) for side in (0.4, -0.4))
    corner = lambda x0, y0: jb.nearest_node(mesh, (x0, y0))
    tip = np.flatnonzero(np.abs(x - 1.5) < 1e-9)
    terms = (
        jb.solid(mesh, jb.lame(np.linspace(1e3, 2e3, len(mesh.elements)), 0.3), jb.neo_hookean, degree=4),
        jb.tendons(mesh, [[corner(-1.5, 0.4), corner(1.0, 0.4)]], 2e3, jb.inverse_stiffness, width=[[0.0, 0.3]]),
        jb.cables(mesh, [[corner(-1.5, -0.4), corner(1.0, -0.4)]], 2e3, transition=0.02),
        jb.pulls(mesh, [[corner(-1.5, 0.4), corner(1.0, 0.0)]]),
        jb.weight(mesh, [0.0, -1.0]),
        jb.traction(mesh, top, [1.0, 0.0]),
        jb.dead_load(mesh, tip[:1], [1.0, 2.0]),
        jb.contact(mesh, bottom, jb.box([0.0, -1.2], [0.8, 1.0], 5.0), 3e3, 0.02),
        jb.contact(mesh, bottom, jb.half_plane([0.0, -2.0], [0.0, 1.0]), 3e3, 0.02),
        jb.penalty_springs(mesh, tip, 10.0),
        jb.support(mesh, tip[1:2], y=1.0),
    )
    return jb.Scene(mesh, terms, jb.clamped(mesh, np.flatnonzero(np.abs(x + 1.5) < 1e-9)), tip)


SCENES = {
    "beam": beam,
    "everything": with_everything,
    "rod": lambda: jb.rod_beam(nodes=5),
    "float32": lambda: jb.tendon_beam(nx=5, ny=3, dtype=jnp.float32),
}


def identical(one, other):
    """Whether two trees have the same structure, and leaves of the same kind, dtype and bytes."""
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert type(a) is type(b) and a.dtype == b.dtype and a.shape == b.shape
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


def states(scene, count=3):
    x = np.asarray(scene.mesh.nodes) * np.linspace(1, 1.1, count)[:, None, None]
    commands = np.repeat(np.asarray(commands_of(scene))[None], count, axis=0)
    return solution_of(scene, commands, x, [0, 1, 64])


@pytest.fixture
def saved(tmp_path):
    scene = beam()
    files.save(tmp_path / "a.jb", scene, states(scene))
    return tmp_path / "a.jb"


# ------------------------------------------------------------------------------------------------ contents


@pytest.mark.parametrize("name", SCENES)
def test_the_same_bits(tmp_path, name):
    scene = SCENES[name]()
    solution = states(scene)
    files.save(tmp_path / "a.jb", scene, solution)
    found = files.load(tmp_path / "a.jb")
    identical(found, (scene, solution))
    # Index arrays are structure. They are hashed once, so nobody may write into them.
    for field in ("fixed", "held", "tip", "surface"):
        ours, theirs = getattr(found[0], field), getattr(scene, field)
        assert isinstance(ours, np.ndarray) and not ours.flags.writeable and ours.dtype == theirs.dtype
    assert repr(found) == repr((scene, solution))
    assert [term.energy for term in found[0].terms] == [term.energy for term in scene.terms]
    # The same scene is the same file.
    files.save(tmp_path / "b.jb", *found)
    assert (tmp_path / "a.jb").read_bytes() == (tmp_path / "b.jb").read_bytes()


def test_a_scene_alone(tmp_path):
    files.save(tmp_path / "a.jb", beam())
    scene, solution = files.load(tmp_path / "a.jb")
    identical(scene, beam())
    assert solution is None


def test_the_outline_is_kept(tmp_path):
    """And an archive from before solutions had one is read as well."""
    scene = beam()
    solution = outlined(states(scene), scene.mesh)
    files.save(tmp_path / "a.jb", scene, solution)
    found = files.load(tmp_path / "a.jb")
    identical(found, (scene, solution))
    assert not found[1].outline.flags.writeable and "<svg" in found[1]._repr_html_()
    with np.load(tmp_path / "a.jb") as entries:
        arrays = {name: entries[name] for name in entries.files}
    header = json.loads(bytes(arrays["header"]))
    assert "outline" not in header["solution"]["fields"]
    del header["outline"]
    with open(tmp_path / "b.jb", "w+b") as stream:
        np.savez(stream, **arrays | {"header": np.frombuffer(json.dumps(header).encode(), np.uint8)})
        archive._seal(stream)
    identical(files.load(tmp_path / "b.jb"), (scene, replace(solution, outline=None)))


def test_numpy_opens_it(saved):
    with np.load(saved, allow_pickle=False) as entries:
        header = json.loads(bytes(entries["header"]))
    assert (header["format"], header["version"]) == ("jaxbeam archive", 1)
    assert header["jaxbeam"] == jb.__version__


def test_a_ramp_goes_on_where_it_was(tmp_path):
    """A ramp that is saved and loaded on the way ends in the same bits as one that is not."""
    scene, way = beam(), np.linspace(1.0, 0.7, 5)

    def step(scene, x, ratio):
        return jb.equilibrium(jb.command(scene, [ratio, 1.0]), x)

    whole = [jb.check(step(scene, scene.mesh.nodes, way[0]))]
    for ratio in way[1:]:
        whole.append(jb.check(step(scene, whole[-1].x, ratio)))
    files.save(tmp_path / "a.jb", jb.command(scene, [way[2], 1.0]), whole[2])
    loaded, last = files.load(tmp_path / "a.jb")
    for k in (3, 4):
        last = step(loaded, last.x, way[k])
        identical(last, whole[k])
    assert last.steps > 0


# ---------------------------------------------------------------------------------- functions of the user


MODULE = """
import dataclasses
from typing import NamedTuple
import jax.numpy as jnp
import jaxbeam as jb
from jaxbeam.core.tree import pytree

print("imported", end="")

class Moduli(NamedTuple):
    stiff: object
    other: object

def density(H, params):
    return params.stiff * jnp.sum(H * H)

def law(modulus, commanded):
    return modulus / commanded ** 3

@dataclasses.dataclass(frozen=True)
class Pull(jb.Energy):
    scale: float
    many: tuple = (1, True, "word", None)

    def __call__(self, x, params):
        return self.scale * jnp.sum(params["force"] * x)

    class Inner(jb.Energy):
        def __call__(self, x, params):
            return jnp.sum(params[0] * x[:, 0])
"""


def own_scene(module):
    mesh = jb.rectangle(2.0, 1.0, 3, 2)
    terms = (
        jb.solid(mesh, module.Moduli(1e3, 1.0), module.density),
        jb.tendons(mesh, [[0, 4]], 10.0, module.law),
        jb.Term(module.Pull(0.1), np.array([[5]]), {"force": np.array([2.0])}),
        jb.Term(module.Pull.Inner(), np.array([[5]]), [np.array([2.0])]),
    )
    return jb.Scene(mesh, terms, jb.clamped(mesh, [0, 1]))


def test_modules_of_the_user_are_imported_if_they_are_trusted(tmp_path, monkeypatch, capsys):
    (tmp_path / "my_physics.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    import my_physics  # type: ignore[import-not-found]

    scene = own_scene(my_physics)
    files.save(tmp_path / "a.jb", scene)
    # An instance of a plain class is equal to itself alone, so only its class is compared.
    found, _ = files.load(tmp_path / "a.jb", trust=("my_physics",))
    assert type(found.terms[3].energy) is my_physics.Pull.Inner
    identical(replace(found, terms=found.terms[:3]), replace(scene, terms=scene.terms[:3]))
    del sys.modules["my_physics"]
    capsys.readouterr()
    with pytest.raises(ValueError, match=r'needs density from the module my_physics.* pass trust=\("my_physics",\)'):
        files.load(tmp_path / "a.jb")
    with pytest.raises(ValueError, match="needs density from the module my_physics, which would"):
        files.load(tmp_path / "a.jb", trust=("my_phys", "other"))
    assert capsys.readouterr().out == ""
    (tmp_path / "my_physics.py").write_text(MODULE.replace("def law", "def another_law"))
    with pytest.raises(ValueError, match="needs law from the module my_physics, which has nothing of that name now"):
        files.load(tmp_path / "a.jb", trust=("my_physics",))
    del sys.modules["my_physics"]
    (tmp_path / "my_physics.py").write_text(MODULE.replace("scale: float", "size: float"))
    with pytest.raises(ValueError, match="a my_physics:Pull with the fields scale, many, which has others now"):
        files.load(tmp_path / "a.jb", trust=("my_physics",))
    del sys.modules["my_physics"]
    (tmp_path / "my_physics.py").unlink()
    with pytest.raises(ValueError, match="needs density from the module my_physics, which cannot be imported"):
        files.load(tmp_path / "a.jb", trust=("my_physics",))
    with pytest.raises(ValueError, match="trust: expected a tuple of names of modules"):
        files.load(tmp_path / "a.jb", trust="my_physics")


@pytest.mark.parametrize(
    "name",
    [
        "os:system",
        "jaxbeam.files.disk:os.remove",
        "jaxbeam.files.disk:contextlib",
        "jaxbeam.files.disk:Path",
        "jaxbeamer:f",
        "jaxbeam",
        "jaxbeam.core:checks.missing",
        "jaxbeam:..os:f",
    ],
)
def test_names_that_are_no_functions_of_jaxbeam_are_refused(name):
    with pytest.raises(ValueError, match=r"^path: the archive"):
        names.named(name, ())


def shadow(H, params):
    return jnp.sum(H * H)


hidden, shadow = shadow, None


class Plain:
    def __init__(self):
        self.factor = 2.0

    def __call__(self, x, params):
        return self.factor * jnp.sum(x)


def test_what_cannot_be_stored_is_refused(tmp_path):
    mesh = jb.rectangle(2.0, 1.0, 3, 2)

    def local(H, params):
        return jnp.sum(H * H)

    from_script = lambda H, params: jnp.sum(H * H)
    from_script.__module__, from_script.__qualname__ = "__main__", "my_density"
    solid = lambda density: jb.solid(mesh, jb.lame(1e3, 0.3), density)
    for term, text in [
        (solid(lambda H, params: jnp.sum(H * H)), r"scene\.terms\[0\]\.energy\.density: .*got a lambda; define it"),
        (solid(local), "got a local function; define it by def at the top of a module"),
        (solid(hidden), "expected what test_archive calls shadow, got something else"),
        (solid(from_script), "got my_density of the script that is run; move it into a module of its own"),
        (jb.Term(Plain(), [[0]], np.zeros(1)), r"terms\[0\]\.energy: expected a dataclass.*got a Plain; make it"),
    ]:
        scene = jb.Scene(mesh, (term,), jb.clamped(mesh, [0, 1]))
        with pytest.raises(ValueError, match=text):
            files.save(tmp_path / "a.jb", scene)
    scene = beam()
    inside = lambda scale: files.save(tmp_path / "a.jb", jb.command(scene, scale * jnp.ones(2)))
    with pytest.raises(ValueError, match="commanded: expected concrete values, got a traced array; save outside jit"):
        jax.jit(inside)(1.0)
    with pytest.raises(ValueError, match=r"solution: expected x of shape .* give a solution of this scene"):
        files.save(tmp_path / "a.jb", jb.tendon_beam(nx=7, ny=3), states(scene))
    with pytest.raises(ValueError, match="solution: expected a Solution"):
        files.save(tmp_path / "a.jb", scene, scene.mesh.nodes)
    with pytest.raises(ValueError, match="scene: expected a Scene"):
        files.save(tmp_path / "a.jb", scene.mesh)
    with pytest.raises(ValueError, match=r"path: there is no folder .*; make it first"):
        files.save(tmp_path / "no" / "a.jb", scene)
    assert not list(tmp_path.iterdir())


# -------------------------------------------------------------------------------------------------- damage


def test_every_changed_byte_is_found(saved):
    good = saved.read_bytes()
    for place in [*range(0, len(good), 50), *range(len(good) - 100, len(good))]:
        saved.write_bytes(good[:place] + bytes([good[place] ^ (1 << place % 8)]) + good[place + 1 :])
        with pytest.raises(ValueError, match=r"^path: a\.jb (is damaged|ends without|is no archive)"):
            files.load(saved)


def test_every_length_but_the_whole_is_refused(saved):
    good = saved.read_bytes()
    text = r"^path: (a\.jb (is damaged|ends without|is no archive)|the file .* is empty)"
    for length in [*range(0, len(good), 50), *range(len(good) - 100, len(good))]:
        saved.write_bytes(good[:length])
        with pytest.raises(ValueError, match=text):
            files.load(saved)
    saved.write_bytes(good + b"\n")
    with pytest.raises(ValueError, match="ends without the checksum"):
        files.load(saved)


def test_foreign_files(tmp_path):
    np.savez(tmp_path / "foreign.npz", a=np.arange(3))
    (tmp_path / "text.jb").write_text("not an archive\n" * 100)
    np.save(tmp_path / "array.npy", np.arange(3))
    for name, text in [
        ("foreign.npz", r"foreign\.npz ends without the checksum of an archive of jaxbeam.* is another zip file"),
        ("text.jb", r"text\.jb is no archive of jaxbeam; give a file that files\.save wrote"),
        ("array.npy", r"array\.npy is no archive"),
        ("missing.jb", r"there is no file .*missing\.jb"),
        ("", "got the folder"),
    ]:
        with pytest.raises(ValueError, match=f"^path: .*{text}"):
            files.load(tmp_path / name)


@pytest.mark.parametrize("header", [b"{}", b"[1]", b"\xff", b'{"format": "jaxbeam archive", "version": 1}'])
def test_another_content_under_a_good_checksum(tmp_path, header):
    with open(tmp_path / "a.jb", "w+b") as stream:
        np.savez(stream, header=np.frombuffer(header, np.uint8))
        archive._seal(stream)
    with pytest.raises(ValueError, match=r"a\.jb is no archive of jaxbeam"):
        files.load(tmp_path / "a.jb")


def test_a_later_format(tmp_path, monkeypatch):
    with monkeypatch.context() as later:
        later.setattr(archive, "VERSION", 2)
        later.setattr(jb, "__version__", "7.0")
        files.save(tmp_path / "a.jb", beam())
    with pytest.raises(ValueError, match=r"a\.jb has version 2 of the format, written by jaxbeam 7\.0; this one"):
        files.load(tmp_path / "a.jb")


def test_float64_where_it_is_switched_off(saved):
    with jax.enable_x64(False), pytest.raises(ValueError, match=r"holds float64, which JAX keeps only while"):
        files.load(saved)


# ----------------------------------------------------------------------------------------- killed or full

KILLED = """
import resource, signal, sys
import jax
jax.config.update("jax_enable_x64", True)
from jaxbeam import files
scene, solution = files.load(sys.argv[1])
# The kernel sends the signal at the write that would make a file longer than this.
signal.signal(signal.SIGXFSZ, getattr(signal, sys.argv[2]))
resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))
files.save(sys.argv[1], scene)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="limits of file sizes are those of Unix")
@pytest.mark.parametrize("handler", ["SIG_DFL", "SIG_IGN"])
def test_a_process_that_ends_while_it_writes_leaves_the_earlier_file(saved, handler):
    """Killed in the middle of writing, or told by the system that no more can be written."""
    before, (_, solution) = saved.read_bytes(), files.load(saved)
    assert len(before) > 10_000
    run = subprocess.run([sys.executable, "-c", KILLED, str(saved), handler], cwd=ROOT, capture_output=True, text=True)
    left = [path for path in saved.parent.iterdir() if path != saved]
    if handler == "SIG_DFL":
        assert run.returncode < 0, run.stderr
        assert [0 < path.stat().st_size <= 5000 for path in left] == [True]
    else:
        assert "File too large" in run.stderr
        assert not left
    assert saved.read_bytes() == before
    identical(files.load(saved)[1], solution)
