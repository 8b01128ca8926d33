"""A window in which a beam is steered by hand: sliders for its commands, and a tip that can be dragged.

Solves run in a thread, so that the window answers while JAX compiles. Of the wishes that come meanwhile only the newest
is kept.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, NamedTuple

import jax
import matplotlib
import numpy as np
from matplotlib.backend_bases import Event, MouseButton
from matplotlib.backends import BackendFilter, backend_registry
from matplotlib.figure import Figure

from jaxbeam.core.tree import Numbers
from jaxbeam.plot.drawing import Limits
from jaxbeam.plot.fields import Field
from jaxbeam.plot.lines import command_names
from jaxbeam.plot.steering import Shown, Steering
from jaxbeam.plot.view import HEIGHT, ROW, WIDTH, View
from jaxbeam.scene.measures import jacobians, tip_position
from jaxbeam.scene.nodal import nodal_von_mises_stress, to_nodes
from jaxbeam.scene.scene import Scene
from jaxbeam.scene.stress import strain_energy_density
from jaxbeam.solve.newton import Newton
from jaxbeam.study.expansion import Measure

# What a key shows in colour.
FIELDS: dict[str, Field | None] = {
    "0": None,
    "1": Field(nodal_von_mises_stress, "von Mises stress"),
    "2": Field(lambda scene, x: to_nodes(scene, jacobians(scene, x)), "J = det F", centre=1.0),
    "3": Field(lambda scene, x: to_nodes(scene, strain_energy_density(scene, x)), "strain energy density"),
}
# Milliseconds between two looks at the thread; seconds until a solve is said to go on.
TICK, PATIENCE = 5, 0.3
# Time without drawing after a frame, over the time that the frame took. All that the mouse did meanwhile is then taken
# in at once. Without it a browser gets a frame for each of its moves, and the tip lags more and more behind the mouse.
BREATH = 0.25
# How near to the tip, in points, the mouse must be to take it.
GRIP = 18.0
# Backends of notebooks that show a still picture.
INLINE = ("inline", "module://matplotlib_inline.backend_inline")
# Windows that are open: matplotlib holds the methods that it calls weakly.
OPEN: set[Window] = set()


class Job(NamedTuple):
    """Something to compute: what to call it, what does it in the thread, and what is then done before it is shown."""

    name: str
    run: Callable[[], Shown]
    then: Callable[[], None] = lambda: None


class Window:
    """The window of a scene, on a figure that is empty.

    A slider sets a command. The circle at the tip can be dragged: `reach` finds the commands that bring the tip there,
    from the last answer. Out of reach the tip stays at the nearest point, a cross marks the wish, and the sliders of
    the bounds in the way turn red. A state that cannot be trusted has a red dashed outline, and its remedy beside it.
    Keys 1, 2 and 3 show stress, `J` and energy, 0 none of them, and r goes back to rest.

    Args:
        figure: with a canvas.
        scene: with commands.
        bounds: lowest and highest command, `()` or `(m,)` each; by default 0.4 and 1 for ratios of tendons.
        measure: `(scene, x)` to the point `(2,)` that is dragged, such as a `marker`.
        view: axis limits; by default they hold the body with room around it, and grow as it moves.
        solver: settings of each solve.

    The attribute `shown` is what is drawn now (see `jaxbeam.plot.steering.Shown`), None before the first solve.

    Raises:
        ValueError: if the scene has no commands or the bounds do not hold them.
    """

    def __init__(
        self,
        figure: Figure,
        scene: Scene,
        *,
        bounds: tuple[Numbers, Numbers] | None = None,
        measure: Measure = tip_position,
        view: Limits | None = None,
        solver: Newton = Newton(),
    ) -> None:
        draggable = measure is not tip_position or scene.tip.size > 0
        self.steering = Steering(scene, bounds, measure if draggable else None, solver)
        self.view = View(figure, self.steering, view)
        self.shown: Shown | None = None
        self._grabbed: np.ndarray | None = None
        self._pool = ThreadPoolExecutor(1)
        self._precision = bool(jax.config.read("jax_enable_x64"))
        self._running: tuple[Job, Future[Shown], float] | None = None
        self._waiting: list[Job] = []
        self._compiled: set[str] = set()
        self._free = 0.0  # when the next frame may be drawn
        self._timer = figure.canvas.new_timer(interval=TICK)
        self._timer.add_callback(self.tick)
        self._connect(figure)
        self._ask(Job("the solver", self.steering.begin))
        if draggable:
            self._waiting.append(Job("the search for commands", self.steering.stay))

    def _connect(self, figure: Figure) -> None:
        """Have events of the canvas and the widgets call the methods below."""
        handlers: dict[Any, Callable[[Any], None]] = {
            "draw_event": self.view.on_draw,
            "button_press_event": self._on_press,
            "motion_notify_event": self._on_motion,
            "button_release_event": self._on_release,
            "key_press_event": self._on_key,
            "close_event": self.close,
        }
        self._connections = [figure.canvas.mpl_connect(name, handler) for name, handler in handlers.items()]
        self.view.on_slide(self.pull)
        self.view.button.on_clicked(self.rest)

    # ---------------------------------------------------------------------------------------- what a user does

    def pull(self, commands: Numbers) -> None:
        """Set the commands `(m,)`, as the sliders do."""
        wanted = np.asarray(commands, float)
        self.view.set_sliders(wanted)
        self._ask(Job("the solver", lambda: self.steering.set(wanted)))

    def drag(self, target: Numbers) -> None:
        """Bring the tip to `target` `(2,)`, as the mouse does."""
        wanted = np.asarray(target, float)
        self._ask(Job("the search for commands", lambda: self.steering.drag(wanted)))

    def rest(self, event: Event | None = None) -> None:
        """Go back to rest."""
        self._ask(Job("the solver", self.steering.rest))

    def colour(self, key: str) -> None:
        """Show stress (`"1"`), `J` (`"2"`), energy (`"3"`) or none of them (`"0"`)."""
        field = FIELDS[key]
        if field:
            try:
                jax.eval_shape(field.function(), self.steering.scene, self.steering.scene.mesh.nodes)
            except ValueError as error:
                self.view.say(f"no {field.label}: {error}", wrong=True)
                return
        shown = self.shown
        if shown is None:
            self.view.field = field
            return

        def run() -> Shown:
            if field:
                jax.block_until_ready(field.compiled(shown.scene, shown.solution.x))
            return shown

        def then() -> None:
            self.view.field = field
            self.view.draw_anew(shown.scene, np.asarray(shown.solution.x))

        self._ask(Job(field.label if field else "plain picture", run, then))

    def wait(self) -> Window:
        """Wait until all that was asked for is drawn, compilation included: for scripts, where no window runs."""
        while self._running or self._waiting:
            if self._running:
                wait([self._running[1]])
            time.sleep(max(0.0, self._free - time.monotonic()))
            self.tick()
        return self

    def close(self, event: Event | None = None) -> None:
        """Stop: nothing is solved any more."""
        self._timer.stop()
        self._waiting = []
        self._pool.shutdown(wait=False, cancel_futures=True)
        for connection in self._connections:
            self.view.canvas.mpl_disconnect(connection)

    # ------------------------------------------------------------------------------------------------- events

    def _on_press(self, event: Any) -> None:
        tip, axes = self.view.tip, self.view.axes
        busy = self.view.canvas.widgetlock.locked()  # zooming or panning
        if tip is None or event.inaxes is not axes or event.button != MouseButton.LEFT or busy:
            return
        away = axes.transData.transform(tip) - [event.x, event.y]
        if np.hypot(*away) < GRIP * self.view.figure.dpi / 72:
            self._grabbed = tip - [event.xdata, event.ydata]

    def _on_motion(self, event: Any) -> None:
        if self._grabbed is not None:
            mouse = self.view.axes.transData.inverted().transform((event.x, event.y))
            self.drag(mouse + self._grabbed)

    def _on_release(self, event: Any) -> None:
        self._grabbed = None

    def _on_key(self, event: Any) -> None:
        if event.key in FIELDS:
            self.colour(event.key)
        elif event.key == "r":
            self.rest()

    # ------------------------------------------------------------------------------------------------- solving

    def _ask(self, job: Job) -> None:
        """Do this next. What waits already is not done any more."""
        self._waiting = [job]
        self._timer.start()
        self.tick()

    def tick(self) -> None:
        """Look whether a solve has ended, draw its result, and begin the next one."""
        free = time.monotonic() >= self._free
        ended = self._running if free and self._running and self._running[1].done() else None
        if ended:
            self._running = None
            self._compiled.add(ended[0].name)
        # Begin the next solve before the last one is drawn: both go on at once.
        if self._waiting and not self._running:
            self._begin(self._waiting.pop(0))
        if ended:
            begun = time.monotonic()
            self._finish(*ended[:2])
            ready = time.monotonic()
            self._free = ready + BREATH * (ready - begun)
        if self._running and time.monotonic() - self._running[2] > PATIENCE:
            job, future, _ = self._running
            self._running = job, future, np.inf  # this is said once
            if job.name in self._compiled:
                self.view.say(f"waiting for {job.name} ...")
        if not self._running and not self._waiting:
            self._timer.stop()

    def _begin(self, job: Job) -> None:
        self._running = job, self._pool.submit(self._solve, job), time.monotonic()
        if job.name not in self._compiled:
            self.view.say(f"compiling: {job.name} ...")

    def _solve(self, job: Job) -> Shown:
        # `jax.enable_x64` as a context holds only in the thread that entered it.
        with jax.enable_x64(self._precision):
            return job.run()

    def _finish(self, job: Job, future: Future[Shown]) -> None:
        try:
            self.shown = future.result()
        except Exception as error:  # the window must live on; what went wrong is shown in it
            self.view.say(f"{type(error).__name__}: {error}", wrong=True)
        else:
            job.then()
            # A slider that is being moved is ahead of what is drawn.
            moving = any(slider.drag_active for slider in self.view.sliders)
            self.view.show(self.shown, sliders=not moving)


def interact(
    scene: Scene,
    *,
    bounds: tuple[Numbers, Numbers] | None = None,
    measure: Measure = tip_position,
    view: Limits | None = None,
    solver: Newton = Newton(),
    block: bool | None = None,
) -> Window:
    """Open a window on a scene: sliders for its commands, and a tip that can be dragged. See `Window`.

    On a desktop it comes back when the window is closed. In a notebook run `%matplotlib widget` first, which needs
    ipympl; the window is then part of the cell. On a machine without a screen, `matplotlib.use("webagg")`, which needs
    tornado, opens it in a browser.

    Args:
        scene: with commands.
        bounds: lowest and highest command, `()` or `(m,)` each; by default 0.4 and 1 for ratios of tendons.
        measure: `(scene, x)` to the point `(2,)` that is dragged, such as a `marker`; by default the tip.
        view: axis limits; by default they hold the body with room around it, and grow as it moves.
        solver: settings of each solve.
        block: whether to come back only when the window is closed; by default what `matplotlib.pyplot.show` does.

    Raises:
        ValueError: if the scene has no commands, the bounds do not hold them, or matplotlib's backend opens no windows.
    """
    from matplotlib import pyplot

    backend = matplotlib.get_backend().lower()
    if backend in {*backend_registry.list_builtin(BackendFilter.NON_INTERACTIVE), *INLINE}:
        raise ValueError(
            f"backend: expected one of matplotlib's that opens a window, got {backend!r}; on a desktop install Qt (pip "
            f'install PySide6), in a notebook run "%matplotlib widget" (pip install ipympl), and without a screen use '
            f'matplotlib.use("webagg") (pip install tornado), which opens a browser'
        )
    figure = pyplot.figure(figsize=(WIDTH, HEIGHT + len(command_names(scene)) * ROW))
    try:
        window = Window(figure, scene, bounds=bounds, measure=measure, view=view, solver=solver)
    except ValueError:
        pyplot.close(figure)
        raise
    OPEN.add(window)
    figure.canvas.mpl_connect("close_event", lambda event: OPEN.discard(window))
    pyplot.show(block=block)
    return window
