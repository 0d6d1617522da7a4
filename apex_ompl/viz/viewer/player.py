"""The player of a live page: play, slider, speed, curves and layers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from apex_ompl.types import Array
from apex_ompl.viz.appearance import CLEARANCE_COLORS, LIMIT_COLORS, NOW
from apex_ompl.viz.viewer.page import HOLD, draw
from apex_ompl.viz.viewer.server import Do, asked
from apex_ompl.viz.viewer.shown import Shown, markdown

SPEEDS = {"0.25": 0.25, "0.5": 0.5, "1": 1.0, "2": 2.0, "4": 4.0}
PLOT_HEIGHT = 150  # [pixels]
CURSOR_PERIOD = 0.1  # at which the cursor of the curves is moved [s]


class Player:
    """Shows problems and results side by side, and plays their motions together.

    A source that grows, such as a live run, is followed: its end is shown while it plays.

    Attributes:
        sources: The problems and results shown.
        scenes: Their scenes.
        time: Time of the motion [s].
        replaced: Called when other sources are shown, whose nodes are new.
    """

    def __init__(self, server: Any, do: Do, sources: Sequence[Shown]) -> None:
        """Add the controls, and show ``sources``.

        Args:
            server: A ``viser`` server.
            do: Called by the controls with actions for the page's own thread.
            sources: Problems and results to show.
        """
        self._server, gui = server, server.gui
        self.time, self._waited, self._cursor_at = 0.0, 0.0, -1.0
        self.replaced: list[Callable[[], None]] = []
        self._facts = gui.add_markdown("")
        self._play = gui.add_checkbox("play", initial_value=True)
        self._slider = gui.add_slider("time s", min=0.0, max=1.0, step=0.001, initial_value=0.0)
        self._speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1")
        self._cover = gui.add_checkbox("sphere cover", initial_value=False)
        self._hand_paths = gui.add_checkbox("paths of the hands", initial_value=True)
        self._curves = gui.add_folder("over time")
        self._plots: list[tuple[Any, Array]] = []
        self._slider.on_update(asked(do, self.seek))
        self._cover.on_update(asked(do, self._layers))
        self._hand_paths.on_update(asked(do, self._layers))
        self.show(sources)

    def show(self, sources: Sequence[Shown]) -> None:
        """Show other problems or results in place of those before."""
        self.sources, self.time, self._waited = list(sources), 0.0, 0.0
        with self._server.atomic():
            self._server.scene.reset()
            self.scenes = draw(self._server, sources)
        self._facts.content = "\n\n".join(markdown(one.facts) for one in sources)
        self._slider.value = 0.0
        self._size()
        self._plot()
        self._layers()
        for call in self.replaced:
            call()

    @property
    def duration(self) -> float:
        """Duration of the longest motion [s]."""
        return max(one.duration for one in self.sources)

    def _size(self) -> None:
        """Fit the controls to the duration."""
        duration = self.duration
        for handle in (self._play, self._slider, self._speed, self._hand_paths):
            if handle.visible != (duration > 0.0):
                handle.visible = duration > 0.0
        if duration > 0.0 and self._slider.max != duration:
            self._slider.max = duration

    def step(self, passed: float) -> None:
        """Continue playing.

        Args:
            passed: Time since the last step [s].
        """
        grows = any(one.grows for one in self.sources)
        if grows:
            self._size()
        if self.duration <= 0.0 or not self._play.value:
            return
        if grows:
            self.time = self.duration
        elif self.time >= self.duration:
            self._waited += passed
            if self._waited < HOLD:
                return
            self.time, self._waited = 0.0, 0.0
        else:
            self.time = min(self.time + passed * SPEEDS[self._speed.value], self.duration)
        self._slider.value = round(self.time, 3)
        self._draw()

    def seek(self, time: float) -> None:
        """Go to a time [s], and stop there."""
        self._play.value = False
        self.time = float(time)
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

    def _layers(self, _: Any = None) -> None:
        for one, scene in zip(self.sources, self.scenes, strict=True):
            scene.set_hand_paths_visible(self._hand_paths.value)
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
        times = max(timed, key=lambda one: one.duration).curves["time"]

        def line(one: Shown, name: str, color: str) -> tuple[str, Array, str]:
            label = name if len(timed) == 1 else f"{name}, {one.name}"
            return color, np.interp(times, one.curves["time"], one.curves[name], right=np.nan), label

        colors = [CLEARANCE_COLORS[k % len(CLEARANCE_COLORS)] for k in range(len(timed))]
        gaps = [line(one, "clearance", color) for one, color in zip(timed, colors, strict=True)]
        self._add_plot("clearance mm", times, gaps, max(float(np.nanmax(values)) for _, values, _ in gaps))
        shares = [line(one, name, color) for one in timed for name, color in LIMIT_COLORS.items()]
        self._add_plot("share of limits", times, shares, 1.0)

    def _add_plot(self, title: str, times: Array, lines: Sequence[tuple[str, Array, str]], top: float) -> None:
        series = [{"label": "s"}, *({"label": label, "stroke": color, "width": 1.5} for color, _, label in lines)]
        data = (times, *(values for _, values, _ in lines), np.full(len(times), np.nan))
        series.append({"label": "now", "stroke": NOW, "width": 3, "points": {"show": True, "size": 8}})
        scales = {"x": {"time": False}, "y": {"range": (0.0, 1.05 * top + 1e-6)}}
        with self._curves:
            plot = self._server.gui.add_uplot(
                data, tuple(series), title=title, scales=scales, height=PLOT_HEIGHT, legend={"show": len(lines) > 1}
            )
        self._plots.append((plot, np.asarray(top)))
