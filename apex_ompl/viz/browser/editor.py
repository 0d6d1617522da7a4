"""Editing in a live page: drag obstacles and goals, add boxes, plan, and save the problem."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from apex_ompl import planners
from apex_ompl.errors import ApexError
from apex_ompl.planners.apex_parameters import default_planner
from apex_ompl.result import PlanResult
from apex_ompl.scene.bodies import pose_fields
from apex_ompl.scene.problem import PoseTarget, Problem
from apex_ompl.session import MotionPlanner
from apex_ompl.tasks.pose_goal import PoseGoal, frame_of
from apex_ompl.types import Array
from apex_ompl.viz.browser.nodes import pose_of, turn_of
from apex_ompl.viz.browser.player import Player
from apex_ompl.viz.browser.server import asked
from apex_ompl.viz.browser.shown import Shown

NOTHING, GOAL = "nothing", "goal of "
NEW_BOX, NEW_PLACE = 0.1, (0.5, 0.0, 0.6)  # edge and place of a box that is added [m]
REACHED = 2e-3  # residual of inverse kinematics at which a hand is where it was dragged
QUIET = 0.25  # how long nothing was dragged before faults are explained [s]
CONTROL_SIZE = 0.25  # of what is dragged [m]


class Editor:
    """Edits a problem in the page, and plans in it with a planner that is kept.

    Attributes:
        planner: The planner; its world is the scene.
        start: Start, shape (dof,).
        goal: Goal, shape (dof,), or None where none was found.
        checks: Number of states that were checked while something was dragged.
    """

    def __init__(self, server: Any, do: Callable[[Callable[[], None]], None], player: Player) -> None:
        """Add the controls for what ``player`` shows, a single problem or result."""
        self._server, self._do, self._player = server, do, player
        ready = player.sources[0].setup
        self._problem, robot = ready.problem, ready.robot
        self.planner = MotionPlanner(self._problem.robot)
        self.planner.world.load(self._problem)
        self.start, self.goal = ready.start, ready.goals[0].copy() if len(ready.goals) else None
        self.checks, self._dragged_at, self._explained = 0, 0.0, True
        self._control: Any = None
        gui = server.gui
        with gui.add_folder("edit"):
            self._what = gui.add_dropdown("drag", self._names(), initial_value=NOTHING)
            self._state = gui.add_markdown("")
            add, remove = gui.add_button("add a box"), gui.add_button("remove the obstacle")
        with gui.add_folder("plan"):
            self._name = gui.add_dropdown("planner", planners.names(), initial_value=default_planner(robot.name))
            self._seed = gui.add_number("seed", initial_value=0, min=0, step=1)
            self._limit = gui.add_number("time limit s", initial_value=5.0, min=0.1, max=600.0)
            run = gui.add_button("plan")
            self._file = gui.add_text("file", initial_value=f"{self._problem.name.replace('/', '_')}.yaml")
            save = gui.add_button("save the problem")
            self._said = gui.add_markdown("")
        self._what.on_update(asked(do, self._grab))
        for button, action in ((add, self.add_box), (remove, self.remove), (run, self.plan), (save, self.save)):
            button.on_click(asked(do, partial(self._said_by, action)))
        self._check()

    def _names(self) -> tuple[str, ...]:
        hands = self.planner.robot.hands if self.goal is not None else {}
        return (NOTHING, *self.planner.world.obstacles, *(f"{GOAL}{hand}" for hand in hands))

    def _said_by(self, action: Callable[[], str]) -> None:
        """Do something, and show what it says, or why it failed."""
        try:
            self._said.content = action()
        except (ApexError, OSError) as error:
            self._said.content = f"error: {error}"

    def select(self, name: str) -> None:
        """Choose what is dragged, as in the page."""
        self._what.value = name
        self._grab()

    def _grab(self) -> None:
        """Put a control where the chosen thing is."""
        name = self._what.value
        if self._control is not None:
            self._control.remove()
            self._control = None
        if name == NOTHING:
            return
        if name.startswith(GOAL):
            frame = frame_of(self.planner.robot, name.removeprefix(GOAL), {})
            pose = self.planner.robot.link_pose(np.asarray(self.goal), frame.link) @ frame.pose
        else:
            pose = self.planner.world.obstacles[name].pose
        self._control = self._server.scene.add_transform_controls(
            "/drag", scale=CONTROL_SIZE, wxyz=turn_of(pose), position=pose[:3, 3], depth_test=False
        )
        self._control.on_update(lambda _: self._do(self._drag))

    def _drag(self) -> None:
        if self._control is not None:
            self.drag(pose_of(self._control.wxyz, self._control.position))

    def drag(self, pose: Array) -> None:
        """Move what is chosen to a pose, shape (4, 4), and show whether start and goal are valid then."""
        name, scene = self._what.value, self._player.scenes[0]
        fields = pose_fields(pose)
        if name.startswith(GOAL):
            self._move_goal(name.removeprefix(GOAL), fields)
        elif name != NOTHING:
            self.planner.world.move(name, fields["position"], fields["orientation"])
            scene.move_obstacle(name, pose)
        self._dragged_at, self._explained = time.perf_counter(), False
        self._check()

    def _move_goal(self, hand: str, fields: dict[str, Any]) -> None:
        target = PoseTarget(frame=hand, **fields)
        reach = PoseGoal(self.planner.robot, [target], (), np.asarray(self.goal))
        found = reach.nearest(np.asarray(self.goal))
        if max(reach.errors(found).values()) <= REACHED:
            self.goal = found
            self._player.scenes[0].show_ghost("goal ghost", found)

    def _check(self) -> None:
        """Say whether start and goal are valid, by the kernel."""
        said = []
        for name, q in (("start", self.start), ("goal", self.goal)):
            if q is not None:
                said.append(f"{name} {'free' if self.planner.is_free(q) else '**blocked**'}")
                self.checks += 1
        self._state.content = ", ".join(said)

    def step(self) -> None:
        """Explain faults once nothing is dragged any more."""
        if self._explained or time.perf_counter() - self._dragged_at < QUIET:
            return
        self._explained = True
        scene, said = self._player.scenes[0], []
        for name, q in (("start", self.start), ("goal", self.goal)):
            if q is None:
                continue
            found = self.planner.check(q)
            stands = name == "start" and self._player.duration <= 0.0
            nodes = scene.robot if stands else scene.show_ghost(f"{name} ghost", q)
            scene.explain(name, nodes, q, found.reason, found.contacts)
            said.append(f"{name} {'free' if found else f'blocked: {found.reason}'}, {1e3 * found.clearance:.1f} mm")
        self._state.content = "\n\n".join(said)

    def add_box(self) -> str:
        """Add a box in front of the robot, choose it, and return its name."""
        taken, k = self.planner.world.obstacles, 1
        while f"box_{k}" in taken:
            k += 1
        name = f"box_{k}"
        self.planner.world.add(name=name, box=(NEW_BOX,) * 3, position=NEW_PLACE)
        self._player.scenes[0].add_obstacle(self.planner.world.obstacles[name])
        self._what.options = self._names()
        self.select(name)
        self._dragged_at, self._explained = time.perf_counter(), False
        self._check()
        return name

    def remove(self) -> str:
        """Remove the obstacle that is chosen."""
        name = self._what.value
        if name not in self.planner.world.obstacles:
            return "choose an obstacle first"
        self.planner.world.remove(name)
        self._player.scenes[0].remove_obstacle(name)
        self._what.options = self._names()
        self.select(NOTHING)
        self._check()
        return f"{name} removed"

    def problem(self) -> Problem:
        """Return the problem as it was edited; a goal in the workspace that was not dragged stays one.

        Raises:
            ApexError: There is no goal.
        """
        ready = self._player.sources[0].setup
        kept = self.goal is None or (len(ready.goals) and np.array_equal(self.goal, ready.goals[0]))
        world = self.planner.world
        edited = {"scene": tuple(world.obstacles.values()), "attached": tuple(world.held.values())}
        if kept:
            return self._problem.model_copy(update=edited)
        made = self.planner.problem(self.start, np.asarray(self.goal), self._problem.name)
        return self._problem.model_copy(update={**edited, "goal": made.goal})

    def plan(self) -> str:
        """Plan in the world as it is, and show the result."""
        self._said.content = "planning ..."
        problem = self.problem()
        result = self.planner.plan_problem(
            problem, self._name.value, timeout=float(self._limit.value), seed=int(self._seed.value)
        )
        self._shown(result)
        if not result:
            return f"{result.status.value}: {result.reason}"
        took = result.times.get("total", 0.0)
        return f"{result.solved_by}, {1e3 * took:.0f} ms in all"

    def _shown(self, result: PlanResult) -> None:
        chosen = self._what.value
        self._control = None
        self._player.show([Shown.of(result)])
        self.select(chosen)

    def save(self) -> str:
        """Write the problem as YAML to the file that is named in the page."""
        self.problem().save(self._file.value)
        return f"saved {self._file.value}"
