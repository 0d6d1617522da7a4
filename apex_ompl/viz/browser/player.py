"""The player of a live page: play, slider, speed, curves and layers of what is shown."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from apex_ompl.types import Array
from apex_ompl.viz.browser.page import HOLD, draw
from apex_ompl.viz.browser.server import asked
from apex_ompl.viz.browser.shown import Shown

SPEEDS = {"0.25": 0.25, "0.5": 0.5, "1": 1.0, "2": 2.0, "4": 4.0}
PLOT_HEIGHT = 150  # [pixels]
LINES = (("velocity", "#1f6fb4"), ("acceleration", "#d97a1a"), ("jerk", "#8e44ad"))
CURSOR = "#c8553d"
CURSOR_PERIOD = 0.1  # at which the cursor of the curves is moved [s]


class Player:
    """Shows problems and results side by side, and plays their motions together.

    Attributes:
        sources: What is shown.
        scenes: Their scenes.
        time: Time of the motion [s].
    """

    def __init__(self, server: Any, do: Callable[[Callable[[], None]], None], sources: Sequence[Shown]) -> None:
        """Add the controls, and show ``sources``.

        Args:
            server: A ``viser`` server.
            do: Called by the controls with what is to be done in the page's own thread.
            sources: What is shown.
        """
        self._server, gui = server, server.gui
        self.time, self._waited, self._cursor_at = 0.0, 0.0, -1.0
        self._facts = gui.add_markdown("")
        self._play = gui.add_checkbox("play", initial_value=True)
        self._slider = gui.add_slider("time s", min=0.0, max=1.0, step=0.001, initial_value=0.0)
        self._speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1")
        self._cover = gui.add_checkbox("sphere cover", initial_value=False)
        self._ways = gui.add_checkbox("ways of the hands", initial_value=True)
        self._curves = gui.add_folder("over time")
        self._plots: list[tuple[Any, Array]] = []
        self._slider.on_update(asked(do, self._seek))
        self._cover.on_update(asked(do, self._layers))
        self._ways.on_update(asked(do, self._layers))
        self.show(sources)

    def show(self, sources: Sequence[Shown]) -> None:
        """Show other problems or results in the place of those before."""
        self.sources, self.time, self._waited = list(sources), 0.0, 0.0
        with self._server.atomic():
            self._server.scene.reset()
            self.scenes = draw(self._server, sources)
        self._facts.content = "\n\n".join(one.facts for one in sources)
        moving = self.duration > 0.0
        for handle in (self._play, self._slider, self._speed, self._ways):
            handle.visible = moving
        if moving:
            self._slider.max = self.duration
            self._slider.value = 0.0
        self._plot()
        self._layers()

    @property
    def duration(self) -> float:
        """Duration of the longest motion [s]."""
        return max(one.duration for one in self.sources)

    def step(self, passed: float) -> None:
        """Go on playing.

        Args:
            passed: Time since the last step [s].
        """
        if self.duration <= 0.0 or not self._play.value:
            return
        if self.time >= self.duration:
            self._waited += passed
            if self._waited < HOLD:
                return
            self.time, self._waited = 0.0, 0.0
        else:
            self.time = min(self.time + passed * SPEEDS[self._speed.value], self.duration)
        self._slider.value = round(self.time, 3)
        self._draw()

    def _seek(self) -> None:
        self._play.value = False
        self.time = float(self._slider.value)
        self._draw()

    def _draw(self) -> None:
        with self._server.atomic():
            for one, scene in zip(self.sources, self.scenes, strict=True):
                one.draw(scene, self.time)
        if abs(self.time - self._cursor_at) > CURSOR_PERIOD:
            self._cursor_at = self.time
            for plot, top in self._plots:
                x = plot.data[0]
                line = np.where(np.abs(x - self.time) <= 0.5 * (x[1] - x[0]) + 1e-9, top, np.nan)
                plot.data = (*plot.data[:-1], line)

    def _layers(self) -> None:
        for one, scene in zip(self.sources, self.scenes, strict=True):
            scene.set_ways_visible(self._ways.value)
            if self._cover.value or scene.has_cover:
                scene.show_cover(one.state(self.time), self._cover.value)

    def _plot(self) -> None:
        for plot, _ in self._plots:
            plot.remove()
        self._plots = []
        timed = [one for one in self.sources if one.curves]
        self._curves.visible = bool(timed)
        if not timed:
            return
        longest = max(timed, key=lambda one: one.duration)
        times = longest.curves["time"]

        def at(one: Shown, name: str) -> Array:
            return np.interp(times, one.curves["time"], one.curves[name], right=np.nan)

        gaps = [at(one, "clearance") for one in timed]
        self._add_plot("clearance mm", times, [("#0b6e4f", gap, "clearance mm") for gap in gaps], np.nanmax(gaps))
        shares = [(colour, at(one, name), name) for one in timed for name, colour in LINES]
        self._add_plot("share of limits", times, shares, 1.0)

    def _add_plot(self, title: str, times: Array, lines: Sequence[tuple[str, Array, str]], top: float) -> None:
        series = [{"label": "s"}, *({"label": label, "stroke": colour, "width": 1.5} for colour, _, label in lines)]
        data = (times, *(values for _, values, _ in lines), np.full(len(times), np.nan))
        series.append({"label": "now", "stroke": CURSOR, "width": 3, "points": {"show": True, "size": 8}})
        scales = {"x": {"time": False}, "y": {"range": (0.0, 1.05 * float(top) + 1e-6)}}
        with self._curves:
            plot = self._server.gui.add_uplot(
                data, tuple(series), title=title, scales=scales, height=PLOT_HEIGHT, legend={"show": len(lines) > 1}
            )
        self._plots.append((plot, np.asarray(float(top))))
