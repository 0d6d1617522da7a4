"""Pages that play offline: one self-contained file with a scene, its motion, and curves beside it."""

from __future__ import annotations

import html
import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from apex_ompl.util.files import check_writable, write_atomically
from apex_ompl.viz.appearance import BACKGROUND, CLEARANCE_COLORS, LIMIT_COLORS, NOW, focus_of
from apex_ompl.viz.viewer.scene import BrowserScene, rgb
from apex_ompl.viz.viewer.server import serving
from apex_ompl.viz.viewer.shown import Shown, ordered

FRAME_RATE = 30.0  # [1/s]
HOLD, LOOP = 0.6, 5.0  # least time that the last state stays, and least time until the player starts anew [s]
PATH_STATES = 80  # of a drawn path of a hand
FIELD_OF_VIEW = 0.75  # [rad]
AMBIENT = 1.5  # intensity of the light from everywhere
SVG_SIZE = (3.4, 2.6)  # of the curves [inch]

PANEL = """
<style>
#facts {{position: fixed; top: 12px; left: 12px; z-index: 5; max-width: 290px; font: 12px/1.35 sans-serif;
  background: rgba(255, 255, 255, 0.88); border-radius: 6px; padding: 8px 12px; color: #222; pointer-events: none;
  max-height: calc(100vh - 80px); overflow: hidden}}
#facts svg {{width: 100%; height: auto; display: block}}
#facts p {{margin: 2px 0}}
@media (max-width: 700px) {{#facts svg {{display: none}}}}
</style>
<div id="facts">{facts}{curves}</div>
<script>
(function () {{
  const duration = {duration}, left = {left}, right = {right};
  function move() {{
    const slider = document.querySelector('[role="slider"]'), cursor = document.getElementById("cursor");
    if (slider && cursor && duration > 0) {{
      const share = Math.min(parseFloat(slider.getAttribute("aria-valuenow")) / duration, 1.0);
      cursor.setAttribute("transform", "translate(" + share * (right - left) + ", 0)");
    }}
    window.requestAnimationFrame(move);
  }}
  move();
}})();
</script>
"""
"""Overlay of the scene: facts, curves, and a cursor that follows the player's slider."""


def write_page(sources: Sequence[Shown], out: str | os.PathLike[str], cover: bool = False) -> None:
    """Write problems or results, side by side, as one page that needs no network.

    The motions play together; the page has a slider, speeds, and a tree of the scene in which layers can be hidden.

    Args:
        sources: Problems or results to show.
        out: Where to write: .html.
        cover: Whether the page has the sphere cover as a layer; it is hidden at first.

    Raises:
        MissingFileError: The file cannot be written, or the ``view`` extra is not installed.
    """
    path = Path(out)
    check_writable(path)
    with serving() as server:
        text = _recorded(server, sources, cover)
    end = text.rindex("</body>")
    write_atomically(path, (text[:end] + _panel(sources) + text[end:]).encode())


def _recorded(server: Any, sources: Sequence[Shown], cover: bool) -> str:
    scenes = draw(server, sources)
    if cover:
        for one, scene in zip(sources, scenes, strict=True):
            scene.show_cover(one.setup.start, visible=False)
    recorder = server.get_scene_serializer()
    duration = max(one.duration for one in sources)
    if duration > 0.0:
        times = np.linspace(0.0, duration, max(2, round(duration * FRAME_RATE) + 1))
        for time in times:
            for one, scene in zip(sources, scenes, strict=True):
                one.draw(scene, float(time))
            recorder.insert_sleep(duration / (len(times) - 1))
        # The player builds the whole scene anew each time, which takes a second where no graphics card is.
        recorder.insert_sleep(max(HOLD, LOOP - duration))
    found: str = recorder.as_html()
    return found


def draw(server: Any, sources: Sequence[Shown]) -> list[BrowserScene]:
    """Draw sources side by side, with ghosts and paths of the hands, and point the camera at them."""
    scenes = []
    server.scene.set_background_image(np.full((1, 1, 3), rgb(BACKGROUND), np.uint8), format="png")
    server.scene.configure_environment_map(None)  # forty times as fast where no graphics card is
    server.scene.add_light_ambient("/ambient", intensity=AMBIENT)
    for k, (one, offset) in enumerate(ordered(sources)):
        scene = BrowserScene(server.scene, one.setup, f"/{k + 1}", offset)
        for name, q, fault in one.ends:
            if q is None:
                continue
            nodes = scene.robot if name == "start" and one.duration <= 0.0 else scene.show_ghost(f"{name} ghost", q)
            if fault:
                scene.explain(name, nodes, q, fault, one.setup.checker.contacts(q))
        if one.duration > 0.0:
            scene.show_hand_paths(one.states(PATH_STATES))
        one.draw(scene, 0.0)
        scenes.append(scene)
    place_camera(server, sources)
    return scenes


def place_camera(server: Any, sources: Sequence[Shown]) -> None:
    """Point the camera at the middle of hands and scenes, from the front of the robot."""
    found = [(*focus_of(one.setup), np.asarray(offset)) for one, offset in ordered(sources)]
    focus = np.mean([point + offset for point, _, offset in found], axis=0)
    spread = max(wide for _, wide, _ in found) + abs(found[-1][2][1])
    aside = 0.42 if len(sources) == 1 else 0.0
    server.initial_camera.look_at = focus
    server.initial_camera.position = focus + max(2.9, 1.2 * spread) * np.array([0.85, aside, 0.45])
    server.initial_camera.fov = FIELD_OF_VIEW
    server.initial_camera.up = (0.0, 0.0, 1.0)


def _panel(sources: Sequence[Shown]) -> str:
    """Return the facts and the curves as HTML."""
    rows = [row for one in sources for row in (f"<b>{html.escape(one.facts[0])}</b>", *map(html.escape, one.facts[1:]))]
    facts = "".join(f"<p>{row}</p>" for row in rows)
    duration = max(one.duration for one in sources) + HOLD
    curves, left, right = _curves(sources, duration)
    return PANEL.format(facts=facts, curves=curves, duration=duration, left=left, right=right)


def _curves(sources: Sequence[Shown], duration: float) -> tuple[str, float, float]:
    """Return clearance and use of limits over time as SVG, and the axes' left and right border in its units."""
    timed = [one for one in sources if one.curves]
    if not timed:
        return "", 0.0, 0.0
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "apex", "font.size": 7}):
        figure = Figure(figsize=SVG_SIZE)
        axes = figure.subplots(2, 1, sharex=True)
        figure.subplots_adjust(left=0.13, right=0.97, top=0.98, bottom=0.13, hspace=0.12)
        for k, one in enumerate(timed):
            curves, style = one.curves, ("-", "--", ":", "-.")[k % 4]
            shade = CLEARANCE_COLORS[k % len(CLEARANCE_COLORS)]
            axes[0].plot(curves["time"], curves["clearance"], style, color=shade, linewidth=1.0, label=one.name)
            for name, color in LIMIT_COLORS.items():
                label = name if k == 0 else None
                axes[1].plot(curves["time"], curves[name], style, color=color, linewidth=0.8, label=label)
        axes[0].set(ylabel="clearance mm", ylim=(0.0, None), xlim=(0.0, duration))
        if len(timed) > 1:
            axes[0].legend(fontsize=5, loc="upper right", frameon=False)
        axes[1].set(ylabel="share of limit", xlabel="time s", ylim=(0.0, 1.05))
        axes[1].legend(fontsize=6, loc="upper right", frameon=False)
        cursor = figure.add_artist(Line2D([0.13, 0.13], [0.13, 0.98], color=NOW, linewidth=0.9))
        cursor.set_gid("cursor")
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    drawn = buffer.getvalue()
    width = 72.0 * SVG_SIZE[0]
    return drawn[drawn.index("<svg") :], 0.13 * width, 0.97 * width
