"""Editing in a live page: drag obstacles and goals, add boxes, plan, and save the problem."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl import planners
from apex_ompl.apex.parameters import NAME
from apex_ompl.constraints.frames import frame_of
from apex_ompl.errors import ApexError, ParameterError
from apex_ompl.goals.pose_goal import PoseGoal
from apex_ompl.planning import MotionPlanner
from apex_ompl.scene.bodies import pose_fields
from apex_ompl.scene.problem import PoseTarget, Problem
from apex_ompl.types import Array
from apex_ompl.viz.viewer.player import Player
from apex_ompl.viz.viewer.scene import pose_of, turn_of
from apex_ompl.viz.viewer.server import Asked, Do, asked
from apex_ompl.viz.viewer.shown import Shown, markdown

NOTHING, GOAL = "nothing", "goal of "
NEW_BOX, NEW_PLACE = 0.1, (0.5, 0.0, 0.6)  # edge and place of a box that is added [m]
REACHED = 2e-3  # residual of inverse kinematics up to which a dragged hand counts as reached
QUIET = 0.25  # pause of the editing before faults are explained [s]
CONTROL_SIZE = 0.25  # of the handle for dragging [m]
LONGEST = 60.0  # time limit of a plan [s]; the page waits for it


class Editor:
    """Edits a problem in the page, and plans in it with a kept planner.

    Attributes:
        planner: The planner; its world is the scene.
        start: Start, shape (dof,).
        goal: Goal, shape (dof,), or None where none was found. It is a state of a goal in the workspace, until it is
            dragged.
    """

    def __init__(self, server: Any, do: Do, player: Player) -> None:
        """Add the controls for the single problem or result that ``player`` shows."""
        self._server, self._do, self._player = server, do, player
        shown = player.sources[0]
        self._problem, robot = shown.setup.problem, shown.setup.robot
        held = () if shown.result is None else shown.result.held_joints
        self._group = [name for name in robot.joint_names if name not in held] if held else None
        self.planner = MotionPlanner(self._problem.robot)
        self.planner.world.load(self._problem)
        self.start, self.goal = shown.setup.start, shown.ends[-1][1]
        self._goal_dragged, self._is_reached = False, True
        self._edited_at, self._is_explained, self._written = 0.0, True, set[Path]()
        self._grabbed = NOTHING
        self._control: Any = None
        gui = server.gui
        with gui.add_folder("edit"):
            self._what = gui.add_dropdown("drag", self._names(), initial_value=NOTHING)
            self._state = gui.add_markdown("")
            add, remove = gui.add_button("add a box"), gui.add_button("remove the obstacle")
        with gui.add_folder("plan"):
            self._planner = gui.add_dropdown("planner", planners.names(), initial_value=NAME)
            self._seed = gui.add_number("seed", initial_value=0, min=0, step=1)
            self._limit = gui.add_number("time limit s", initial_value=5.0, min=0.1, max=LONGEST)
            run = gui.add_button("plan")
            self._file = gui.add_text("file", initial_value=f"{self._problem.name.replace('/', '_')}.yaml")
            save = gui.add_button("save the problem")
            self._said = gui.add_markdown("")
        self._what.on_update(asked(do, self.grab))
        for button, action in ((add, self.add_box), (remove, self.remove), (run, self.plan), (save, self.save)):
            button.on_click(asked(do, partial(self._say, action)))
        player.replaced.append(self._replaced)
        self._check()

    def _names(self) -> tuple[str, ...]:
        hands = self.planner.robot.hands if self.goal is not None else {}
        return (NOTHING, *self.planner.world.obstacles, *(f"{GOAL}{hand}" for hand in hands))

    def _say(self, action: Callable[[], str], _: Any = None) -> None:
        """Run an action, and show its message, or why it failed."""
        try:
            said = action()
        except (ApexError, OSError) as error:
            said = f"error: {error}"
        self._said.content = markdown([said])

    def grab(self, name: str) -> None:
        """Choose the dragged object, an obstacle or the goal of a hand, and put a control there."""
        if self._control is not None:
            self._control.remove()
        self._grabbed, self._control = name, None
        if self._what.value != name:
            self._what.value = name
        if name == NOTHING:
            return
        if name.startswith(GOAL):
            frame = frame_of(self.planner.robot, name.removeprefix(GOAL), {})
            pose = self.planner.robot.link_pose(np.asarray(self.goal), frame.link) @ frame.pose
        else:
            pose = self.planner.world.obstacles[name].pose
        control = self._control = self._server.scene.add_transform_controls(
            "/drag", scale=CONTROL_SIZE, wxyz=turn_of(pose), position=pose[:3, 3], depth_test=False
        )
        drag = partial(self._drag_by, control)
        control.on_update(lambda _: self._do(Asked(drag, pose_of(control.wxyz, control.position))))

    def _replaced(self) -> None:
        """Put a new control at the chosen object, whose nodes are new."""
        self._control = None
        self.grab(self._grabbed)

    def _drag_by(self, control: Any, pose: Array) -> None:
        if control is self._control:
            self.drag(pose)

    def drag(self, pose: Array) -> None:
        """Move the chosen object to a pose, shape (4, 4), and show whether start and goal are free then."""
        fields = pose_fields(pose)
        if self._grabbed.startswith(GOAL):
            self._move_goal(self._grabbed.removeprefix(GOAL), fields)
        elif self._grabbed != NOTHING:
            self.planner.world.move(self._grabbed, fields["position"], fields["orientation"])
            self._player.scenes[0].move_obstacle(self._grabbed, pose)
        self._check()

    def _move_goal(self, hand: str, fields: dict[str, Any]) -> None:
        target = PoseTarget(frame=hand, **fields)
        reach = PoseGoal(self.planner.robot, [target], (), np.asarray(self.goal))
        found = reach.nearest(np.asarray(self.goal))
        self._is_reached = max(reach.errors(found).values()) <= REACHED
        if self._is_reached:
            self.goal, self._goal_dragged = found, True
            self._player.scenes[0].show_ghost("goal ghost", found)

    def _check(self) -> None:
        """Show whether start and goal are free, by the kernel; reasons follow when the editing pauses."""
        self._edited_at, self._is_explained = time.perf_counter(), False
        states = [("start", self.start), *([] if self.goal is None else [("goal", self.goal)])]
        said = [f"{name} {'free' if self.planner.is_free(q) else '**blocked**'}" for name, q in states]
        self._state.content = ", ".join([*said, *([] if self._is_reached else ["out of reach"])])

    def step(self) -> None:
        """Explain faults once the editing pauses, and put the control back to its object."""
        if self._is_explained or time.perf_counter() - self._edited_at < QUIET:
            return
        self._is_explained = True
        if not self._is_reached:
            self._is_reached = True
            self.grab(self._grabbed)
        scene, said = self._player.scenes[0], []
        for name, q in (("start", self.start), ("goal", self.goal)):
            if q is None:
                continue
            found = self.planner.check(q)
            stands = name == "start" and self._player.duration <= 0.0
            nodes = scene.robot if stands else scene.show_ghost(f"{name} ghost", q)
            scene.explain(name, nodes, q, found.reason, found.contacts)
            said.append(f"{name} {'free' if found else f'blocked: {found.reason}'}, {1e3 * found.clearance:.1f} mm")
        self._state.content = markdown(said)

    def add_box(self) -> str:
        """Add a box in front of the robot, choose it, and return its name."""
        k = next(k for k in range(1, 10_000) if f"box_{k}" not in self.planner.world.obstacles)
        name = f"box_{k}"
        self.planner.world.add(name=name, box=(NEW_BOX,) * 3, position=NEW_PLACE)
        self._player.scenes[0].add_obstacle(self.planner.world.obstacles[name])
        self._what.options = self._names()
        self.grab(name)
        self._check()
        return name

    def remove(self) -> str:
        """Remove the obstacle that is chosen."""
        name = self._grabbed
        if name not in self.planner.world.obstacles:
            return "choose an obstacle first"
        self.planner.world.remove(name)
        self._player.scenes[0].remove_obstacle(name)
        self.grab(NOTHING)
        self._what.options = self._names()
        self._check()
        return f"{name} removed"

    def problem(self) -> Problem:
        """Return the edited problem; a goal that was not dragged is unchanged."""
        world = self.planner.world
        edited: dict[str, Any] = {
            "scene": tuple(world.obstacles.values()), "attached": tuple(world.held.values()), "allowed": world.allowed
        }  # fmt: skip
        if self._goal_dragged:
            made = self.planner.problem(self.start, np.asarray(self.goal), self._problem.name)
            edited["goal"] = made.goal
        return self._problem.model_copy(update=edited)

    def plan(self) -> str:
        """Plan in the current world, show the result, and return a message about it.

        Dynamic obstacles are assumed to stand still.

        Raises:
            ApexError: The seed, the time limit or the problem is faulty.
        """
        self._said.content = "planning ..."
        problem = self.problem()
        try:
            result = self.planner.plan_problem(
                problem, self._planner.value, timeout=float(self._limit.value), seed=int(self._seed.value),
                group=self._group, snapshot=bool(problem.moving),
            )  # fmt: skip
        except ApexError:
            self.planner.world.load(problem)
            raise
        if not self._goal_dragged and result.path is not None:
            self.goal = result.path.states[-1]
        self._player.show([Shown.of(result)])
        self._check()
        notes = "".join(f"; {note}" for note in result.notes)
        if not result:
            return f"{result.status.value}: {result.reason}{notes}"
        return f"{result.solved_by}, {1e3 * result.times.get('total', 0.0):.0f} ms in all{notes}"

    def save(self) -> str:
        """Write the problem as YAML to the file that is named in the page, in the working folder.

        Raises:
            ParameterError: The name does not end in .yaml, or is that of a file that this page did not write.
            ApexError: The file cannot be written.
        """
        path = Path(self._file.value)
        if path.name != self._file.value or path.suffix not in (".yaml", ".yml"):
            raise ParameterError("file", self._file.value, "a name ending in .yaml, without a folder")
        if path.exists() and path.absolute() not in self._written:
            raise ParameterError("file", self._file.value, "the name of a file that is not there yet")
        self.problem().save(path)
        self._written.add(path.absolute())
        return f"saved {path.absolute()}"
