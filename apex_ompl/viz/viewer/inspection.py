"""Proposals of the model in a page, as they are sampled, guided and repaired, and their denoising."""

from __future__ import annotations

from typing import Any

import numpy as np

from apex_ompl.apex.model_search import NONE, find_model
from apex_ompl.apex.models import make_query
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ApexError
from apex_ompl.model.checkpoint import shared_model
from apex_ompl.model.guidance import Guidance
from apex_ompl.model.proposals import Sampling, TrajectoryModel
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.paths.path import FINE_RESOLUTION
from apex_ompl.paths.spline import Spline
from apex_ompl.scene.scripts import problem_at
from apex_ompl.types import Array
from apex_ompl.viz.appearance import DENOISED, PROPOSAL_COLORS
from apex_ompl.viz.viewer.editor import Editor
from apex_ompl.viz.viewer.player import Player
from apex_ompl.viz.viewer.server import Do, asked
from apex_ompl.viz.viewer.shown import markdown

STEPS = 24  # of the denoising that is shown
REPAIR_STEPS = 48  # of the optimizer on each proposal
STATES = 60  # of a drawn path


class Inspection:
    """Draws the paths of the hands along a model's proposals for the problem that is shown."""

    def __init__(self, server: Any, do: Do, player: Player, editor: Editor) -> None:
        """Add the controls for the single problem or result that ``player`` shows, as edited by ``editor``."""
        self._player, self._editor, self._nodes = player, editor, dict[str, Any]()
        self._estimates: list[Array] = []
        self._model: TrajectoryModel | None = None
        self._name = find_model(player.sources[0].setup.robot).name
        if self._name == NONE:
            return
        with server.gui.add_folder("proposals", expand_by_default=False):
            self._count = server.gui.add_slider("number", min=1, max=64, step=1, initial_value=8)
            self._gamma = server.gui.add_number("guidance", initial_value=1.0, min=0.0)
            self._seed = server.gui.add_number("seed", initial_value=0, min=0, step=1)
            draw = server.gui.add_button("draw proposals")
            self._said = server.gui.add_markdown("")
            self._seen = {
                kind: server.gui.add_checkbox(kind, initial_value=kind != "sampled") for kind in PROPOSAL_COLORS
            }
            self._step = server.gui.add_slider("denoising", min=0, max=STEPS, step=1, initial_value=STEPS)
        player.replaced.append(self._forget)
        draw.on_click(asked(do, self.draw))
        self._step.on_update(asked(do, self.denoise))
        for box in self._seen.values():
            box.on_update(asked(do, self._layers))

    def _forget(self) -> None:
        """Forget the drawn proposals, whose nodes are gone."""
        self._nodes, self._estimates, self._said.content = {}, [], ""

    def draw(self, _: Any = None) -> None:
        """Draw proposals as they are sampled, guided and repaired, and show how many are valid."""
        try:
            said = self._drawn()
        except ApexError as error:
            said = f"error: {error}"
        self._said.content = markdown([said])

    def _drawn(self) -> str:
        editor, robot = self._editor, self._editor.planner.robot
        if editor.goal is None:
            return "there is no goal"
        problem = problem_at(editor.problem(), 0.0)
        checker = CollisionChecker(robot, problem.scene, problem.attached, problem.allowed)
        if self._model is None:
            self._model = shared_model(self._name, device="cpu", robot=robot.name)
        model, kernel = self._model, checker.kernel
        query = make_query(checker, editor.start, editor.goal, point=model.sees_point)
        count, seed = int(self._count.value), int(self._seed.value)
        estimates: list[Array] = []

        def propose(gamma: float, callback: Any = None) -> Array:
            sampling = Sampling("ddim", STEPS, guidance=Guidance(gamma=gamma))
            generator = np.random.default_rng(seed)
            return model.propose(
                query, kernel, count, sampling=sampling, generator=generator, callback=callback
            ).control

        def watch(step: int, latent: Any, estimate: Any) -> None:
            ends = np.repeat(query.start[None], count, axis=0), np.repeat(query.goal[None], count, axis=0)
            estimates.append(model.control(estimate.clean, ends))

        with model.one_thread():
            sampled, guided = propose(0.0), propose(float(self._gamma.value), watch)
        optimizer = Optimizer(model.spline)
        improved = optimizer.improve(kernel, guided, steps=REPAIR_STEPS).control
        proved = [kernel.proves(path, FINE_RESOLUTION) for path in model.spline.path(improved)]
        groups = {
            "sampled": sampled, "guided": guided, "repaired": improved[proved],
            "not repaired": improved[~np.array(proved)],
        }  # fmt: skip
        for kind, control in groups.items():
            self._redraw(kind, control, model.spline, PROPOSAL_COLORS[kind])
        self._estimates = [*estimates, guided]
        self.denoise()
        self._layers()
        before = sum(kernel.proves(path, FINE_RESOLUTION) for path in model.spline.path(guided))
        return f"{count} proposals: {before} free as they are, {sum(proved)} after {REPAIR_STEPS} steps of repair"

    def denoise(self, _: Any = None) -> None:
        """Draw the model's estimate of the guided proposals after some steps of denoising."""
        if self._estimates and self._model is not None:
            k = min(int(self._step.value), len(self._estimates) - 1)
            self._redraw("denoising", self._estimates[k], self._model.spline, DENOISED)

    def _redraw(self, name: str, control: Array, spline: Spline, color: str) -> None:
        old = self._nodes.pop(name, None)
        if old is not None:
            old.remove()
        if len(control):
            paths = spline.path(control)[:, :: max(1, spline.states // STATES)]
            self._nodes[name] = self._player.scenes[0].show_lines(f"proposals/{name}", list(paths), color)

    def _layers(self, _: Any = None) -> None:
        for kind, box in self._seen.items():
            if kind in self._nodes:
                self._nodes[kind].visible = box.value
