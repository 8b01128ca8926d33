"""Figures of matplotlib in a real browser: headless Chromium, driven from outside by the W3C WebDriver protocol.

A test opens a figure with `shown`, which runs a function of the test's file in a process of its own, with the backend
WebAgg, and opens its page. The test moves the mouse and presses keys as a person does. What the figure does it writes
by `report`, a line for each event, and the test waits for these lines. All waits have an end, and what was started is
ended in any case. Only the standard library is needed here; WebAgg needs tornado.

    with shown(__file__, "figure") as page:
        page.drag(page.place(100, 200), page.place(300, 200))
        page.wait_for(lambda event: event["name"] == "moved")
"""

from __future__ import annotations

import base64
import contextlib
import importlib.util
import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

# The longest wait for a program to start, and for a page, an answer or an event, in seconds.
START, ANSWER = 20.0, 8.0
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--force-device-scale-factor=1",
)
KEYS = {"left": "\ue012", "up": "\ue013", "right": "\ue014", "down": "\ue015", "escape": "\ue00c", "enter": "\ue007"}

Place = tuple[float, float]


def missing() -> str:
    """What there is not for a test in a browser, in words; empty if all is there."""
    for what, found in (("Chromium", _chromium()), ("chromedriver", _driver())):
        if found is None:
            return f"{what} is not installed"
    return "" if importlib.util.find_spec("tornado") else "tornado is not installed"


def _chromium() -> str | None:
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def _driver() -> str | None:
    return next(filter(None, map(shutil.which, ("chromedriver", "chromium-driver", "chromium.chromedriver"))), None)


# ------------------------------------------------------------------------------------------------ processes


class Program:
    """A process and the lines that it writes. It is ended, with all processes that it started, by `end`."""

    def __init__(self, command: list[str], environment: dict[str, str] | None = None) -> None:
        self.process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=os.environ | (environment or {}),
            start_new_session=True,
        )
        self.lines: list[str] = []
        self._arriving: queue.Queue[str | None] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._arriving.put(line.rstrip("\n"))
        self._arriving.put(None)

    def wait_for(self, found: Callable[[str], Any], seconds: float) -> Any:
        """The first true value of `found` of a line that was not waited for before.

        Raises:
            TimeoutError: if there is none in time, or the process has ended. It shows the last lines.
        """
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            try:
                line = self._arriving.get(timeout=left)
            except queue.Empty:
                break
            if line is None:
                self._arriving.put(None)
                break
            self.lines.append(line)
            if value := found(line):
                return value
        raise TimeoutError(f"{self.process.args} wrote nothing that was waited for; its last lines are\n" + self.tail())

    def tail(self) -> str:
        return "\n".join(self.lines[-20:])

    def end(self) -> None:
        """End the process and those that it started: first asked to, then forced."""
        for sign in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.process.pid, sign)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(3)
        self._reader.join(3)
        assert self.process.stdout is not None
        self.process.stdout.close()


# ------------------------------------------------------------------------------------------------ the browser


class Browser:
    """A session of Chromium. Places on the page are `(x, y)` in pixels from its upper left corner."""

    def __init__(self, session: str) -> None:
        self.session = session

    def ask(self, method: str, path: str, **body: Any) -> Any:
        """One command of the protocol. Raises `RuntimeError` with the browser's words if it fails."""
        return _ask(method, self.session + path, body if method == "POST" else None)

    def open(self, url: str) -> None:
        self.ask("POST", "/url", url=url)

    def run(self, script: str, *arguments: Any) -> Any:
        """What the body of a JavaScript function returns; `arguments[0]` is the first argument."""
        return self.ask("POST", "/execute/sync", script=script, args=list(arguments))

    def wait_until(self, script: str, *arguments: Any) -> Any:
        """What `run` returns as soon as it is true."""
        end = time.monotonic() + ANSWER
        while not (value := self.run(script, *arguments)):
            if time.monotonic() > end:
                raise TimeoutError(f"the page has not made this true in {ANSWER} s: {script}")
            time.sleep(0.02)
        return value

    def screenshot(self) -> bytes:
        """The window as a PNG."""
        return base64.b64decode(self.ask("GET", "/screenshot"))

    def move(self, *places: Place, pause: float = 0.03) -> None:
        """Move the mouse to each of the places in turn, `pause` seconds apart."""
        self._mouse([_to(place, pause) for place in places])

    def drag(self, start: Place, end: Place, steps: int = 10, pause: float = 0.03) -> None:
        """Press the left button at one place, go to another in so many even steps, and release it."""
        shares = [k / steps for k in range(1, steps + 1)]
        way = [tuple(a + share * (b - a) for a, b in zip(start, end, strict=True)) for share in shares]
        press, release = ({"type": kind, "button": 0} for kind in ("pointerDown", "pointerUp"))
        self._mouse([_to(start, pause), press, *(_to(place, pause) for place in way), release])

    def click(self, place: Place) -> None:
        self.drag(place, place, steps=1)

    def press(self, *keys: str) -> None:
        """Press and release keys, each a character or a name of `KEYS`."""
        strokes = [{"type": kind, "value": KEYS.get(key, key)} for key in keys for kind in ("keyDown", "keyUp")]
        self.ask("POST", "/actions", actions=[{"type": "key", "id": "keyboard", "actions": strokes}])

    def _mouse(self, actions: list[dict[str, Any]]) -> None:
        mouse = {"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}, "actions": actions}
        self.ask("POST", "/actions", actions=[mouse])


def _to(place: Place, pause: float) -> dict[str, Any]:
    x, y = (round(value) for value in place)
    return {"type": "pointerMove", "origin": "viewport", "x": x, "y": y, "duration": round(1000 * pause)}


def _ask(method: str, url: str, body: Any = None) -> Any:
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(url, data, {"Content-Type": "application/json"}, method=method)
    # The driver is on this machine, whatever proxy the environment names.
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(request, timeout=START) as answer:
            return json.load(answer)["value"]
    except urllib.error.HTTPError as error:
        with error:
            raise RuntimeError(f"{method} {url}: {json.load(error)['value']['message']}") from None


@contextlib.contextmanager
def browser(width: int = 1000, height: int = 900) -> Iterator[Browser]:
    """A headless Chromium with a window of this size, closed at the end."""
    chromium, driver = _chromium(), _driver()
    assert chromium and driver, missing()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        program = Program([driver, "--port=0"])
        try:
            said = program.wait_for(lambda line: "started successfully on port" in line and line, START)
            root = f"http://127.0.0.1:{said.rstrip('.').split()[-1]}/session"
            flags = [*FLAGS, f"--user-data-dir={folder}", f"--window-size={width},{height}"]
            limits = {name: int(1000 * ANSWER) for name in ("script", "pageLoad")}
            wanted = {"goog:chromeOptions": {"binary": chromium, "args": flags}, "timeouts": limits}
            session = _ask("POST", root, {"capabilities": {"alwaysMatch": wanted}})["sessionId"]
            page = Browser(f"{root}/{session}")
            try:
                yield page
            finally:
                # A browser that does not answer any more is ended with its driver.
                with contextlib.suppress(OSError, RuntimeError):
                    page.ask("DELETE", "")
        finally:
            program.end()


# ------------------------------------------------------------------------------------------------ figures


class Page(Browser):
    """The page of a figure."""

    def __init__(self, session: str, figure: Program) -> None:
        super().__init__(session)
        self.figure = figure

    def place(self, x: float, y: float) -> Place:
        """The place on the page of a point in matplotlib's display coordinates: pixels from the lower left corner."""
        rect = "const r = document.querySelector('canvas.mpl-canvas').getBoundingClientRect();"
        left, bottom = self.run(rect + "return [r.left, r.bottom]")
        return left + x, bottom - y

    def wait_for(self, found: Callable[[dict[str, Any]], Any], seconds: float = ANSWER) -> dict[str, Any]:
        """The next event reported by the figure that is as wanted; those before it are passed over."""

        def read(line: str) -> dict[str, Any] | None:
            event = json.loads(line) if line.startswith("{") else None
            return event if event is not None and found(event) else None

        return self.figure.wait_for(read, seconds)


@contextlib.contextmanager
def shown(file: str | Path, function: str, width: int = 1000, height: int = 900) -> Iterator[Page]:
    """The page of the figure that a function of a Python file makes, in a browser, with its first frame shown.

    Args:
        file: such as the test's own `__file__`.
        function: name of a function without arguments that makes one figure with pyplot.
        width: of the browser's window, which must show all of the figure.
        height: of the browser's window.

    Keys that matplotlib has a meaning for act as well: `s` asks for a file name in a new window, in which the session
    hangs. Clear `rcParams["keymap.save"]` where it is pressed.
    """
    root = Path(__file__).parents[1]
    paths = os.pathsep.join([str(root), str(root / "tests"), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-u", "-W", "error", __file__, str(file), function]
    program = Program(command, {"MPLBACKEND": "webagg", "PYTHONPATH": paths})
    try:
        said = program.wait_for(lambda line: line.startswith("To view figure, visit") and line, START)
        with browser(width, height) as session:
            page = Page(session.session, program)
            page.open(said.split()[-1].rstrip("/") + "/1")
            # The canvas is transparent until the first frame is drawn on it.
            page.wait_until(
                "const c = document.querySelector('canvas.mpl-canvas');"
                "return c && c.width > 0 && c.getContext('2d').getImageData(0, 0, 1, 1).data[3] > 0"
            )
            yield page
    finally:
        program.end()


def report(**values: Any) -> None:
    """Write an event of a figure, as a line that `Page.wait_for` reads."""
    print(json.dumps(values), flush=True)


def _serve(file: str, function: str) -> None:
    """Make a figure and serve it until the process is ended."""
    import matplotlib as mpl
    import matplotlib.pyplot as plt

    mpl.rcParams["webagg.open_in_browser"] = False
    spec = importlib.util.spec_from_file_location(Path(file).stem, file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    getattr(module, function)()
    plt.show()


if __name__ == "__main__":
    _serve(*sys.argv[1:])
