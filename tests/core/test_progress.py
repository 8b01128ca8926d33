"""The line of progress: in place, seldom enough, ended in any case, on terminals alone."""

import io
import time
from types import SimpleNamespace

import numpy as np
import optax
import pytest

import jaxbeam as jb
from jaxbeam.core.progress import Report, check_progress


@pytest.fixture
def clock(monkeypatch):
    """The time in seconds, as a list of one number that a test may change."""
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


def test_line_is_redrawn_in_place(terminal, clock):
    with Report(True, "commands", 100) as report:
        for done in range(1, 101):
            clock[0] += 0.75
            report(done)
    first, *drawn = terminal.getvalue().removesuffix("\n").split("\r")
    assert first == "" and len(drawn) == 102  # also at the beginning and at the end
    assert drawn[0] == "[------------------------] 0 of 100 commands, 0:00"
    assert drawn[50] == "[############------------] 50 of 100 commands, 0:37"
    assert drawn[-1] == "[########################] 100 of 100 commands, 1:15"
    assert terminal.getvalue().count("\n") == 1


def test_line_is_drawn_at_most_ten_times_a_second(terminal, clock):
    with Report(True, "commands", 1000) as report:
        for done in range(1, 1001):
            clock[0] += 0.002
            report(done)
    drawn = terminal.getvalue().split("\r")[1:]
    assert len(drawn) <= 2 + 20 and drawn[-1].endswith("1000 of 1000 commands, 0:02\n")


def test_unknown_end_shows_count_and_figure_without_a_bar(terminal, clock):
    with Report(True, "solves") as report:
        report(7, "distance 3.2e-05")
        clock[0] += 3723
    assert terminal.lines() == ["7 solves, distance 3.2e-05, 1:02:03", ""]


def test_a_shorter_line_covers_a_longer_one(terminal, clock):
    with Report(True, "solves") as report:
        clock[0] += 1
        report(1, "distance 1.23e-05")
        clock[0] += 1
        report(2)
    assert terminal.lines() == ["2 solves, 0:02", ""]


@pytest.mark.parametrize(("columns", "line"), [(60, "[#########---------] 512 of"), (40, "512 of"), (20, "512 of")])
def test_a_line_fits_into_a_narrow_terminal(terminal, clock, monkeypatch, columns, line):
    """A longer one would go on in the next line, and could not be redrawn."""
    monkeypatch.setattr("jaxbeam.core.progress._columns", lambda stream: columns)
    with Report(True, "commands", 1024) as report:
        clock[0] += 1
        report(512, "finer mesh")
    assert max(map(len, terminal.getvalue().replace("\n", "\r").split("\r"))) < columns
    assert terminal.lines()[0].startswith(line)


def test_line_ends_with_an_exception(terminal):
    with pytest.raises(KeyboardInterrupt), Report(True, "commands", 4) as report:
        report(3)
        raise KeyboardInterrupt
    assert terminal.lines() == ["[##################------] 3 of 4 commands, 0:00", ""]


@pytest.mark.parametrize("stream", [io.StringIO(), None])
def test_silence_without_a_terminal(stream, monkeypatch):
    monkeypatch.setattr("jaxbeam.core.progress.sys", SimpleNamespace(stderr=stream))
    with Report(True, "commands", 4) as report:
        report(4)
    assert stream is None or stream.getvalue() == ""


@pytest.mark.parametrize("progress", [None, False, np.False_, print])
def test_nothing_is_drawn_unless_asked_for(progress, terminal):
    with Report(progress, "commands", 4) as report:
        report(4)
    assert terminal.getvalue() == ""


def test_function_gets_what_it_is_called_with(terminal):
    calls = []
    with Report(lambda *call: calls.append(call), "targets", 2) as report:
        report(0, "figure", (1, 0.5))
        report(1)
    assert calls == [(1, 0.5)] and terminal.getvalue() == ""


@pytest.mark.parametrize("progress", [1, 0, "yes", [print]])
def test_anything_else_is_refused(progress):
    with pytest.raises(ValueError, match=r"progress: expected a function \(solved, all\), or True or False, got"):
        check_progress(progress, "(solved, all)")


BEAM = jb.tendon_beam(5, 3, anchor_width=0.25)


@pytest.mark.parametrize(
    "call",
    [
        lambda progress: jb.sweep(BEAM, [[0.9, 1.0]], progress=progress),
        lambda progress: jb.reach(BEAM, 5.0, progress=progress),
        lambda progress: jb.reach_each(BEAM, [5.0], progress=progress),
        lambda progress: jb.minimise(
            jb.tip_angle, np.ones(2), optax.sgd(1.0), design=lambda r: jb.command(BEAM, r), progress=progress
        ),
        lambda progress: jb.trace_branch(BEAM, [0.9, 1.0], progress=progress),
        lambda progress: jb.solve_to(BEAM, jb.tip_angle, 0.1, progress=progress),
        lambda progress: jb.corrected(jb.two_meshes(BEAM), [0.9, 1.0], jb.tip_angle, progress=progress),
    ],
)
def test_all_long_work_refuses_anything_else(call):
    with pytest.raises(ValueError, match=r"progress: expected a function .*, or True or False, got 3"):
        call(3)
