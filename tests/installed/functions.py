"""Uses of every public function and class, and of the code on the pages of the documentation.

What was called is seen by Python's own trace of calls, so that a public function without a use cannot be forgotten.
"""

from __future__ import annotations

import inspect
import io
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import numpy as np

MODULES = (
    "apex_ompl", "apex_ompl.ompl.space", "apex_ompl.planners", "apex_ompl.problems", "apex_ompl.robot",
    "apex_ompl.perception", "apex_ompl.planning", "apex_ompl.timing",
)  # fmt: skip


def run(root: Path) -> list[str]:
    """Run all uses in this folder, which holds nothing, and return the names of public functions that none calls."""
    called: set[CodeType] = set()
    made: set[type] = set()
    with _traced(called, made):
        _use_planner()
        _use_kinematics()
        _use_tasks()
        _use_records()
        _use_trajectories()
        _use_problems()
        _use_ompl()
        _use_steps()
        _use_run()
        _use_drivers()
        _use_perception()
    (Path("tests")).symlink_to(root / "tests")  # data that a page reads
    for page in (root / "README.md", *sorted((root / "docs").glob("*.md"))):
        code = "\n".join(re.findall(r"```python\n(.*?)```", page.read_text(), re.S))
        with _traced(called, made), redirect_stdout(io.StringIO()):
            exec(compile(code, page.name, "exec"), {"__name__": "__page__"})
    public = [one for one in _public() if find_spec("sensor_msgs") or "Ros2Camera" not in one[0]]
    return [name for name, code, kind in public if code not in called and not any(issubclass(m, kind) for m in made)]


@contextmanager
def _traced(called: set[CodeType], made: set[type]) -> Iterator[None]:
    """Note the code of all functions that are called in a block, and the types of what they make or return."""

    def note(frame: FrameType, event: str, value: Any) -> None:
        if event == "call":
            called.add(frame.f_code)
            if frame.f_code.co_name == "__init__":
                made.add(type(next(iter(frame.f_locals.values()), None)))
        elif event == "return":
            made.add(type(value))

    sys.setprofile(note)
    try:
        yield
    finally:
        sys.setprofile(None)


def _public() -> Iterator[tuple[str, CodeType | None, type | tuple[()]]]:
    """Yield name and code of public functions and methods, and name and class of public classes."""
    for module_name in MODULES:
        module = import_module(module_name)
        own = [name for name, value in vars(module).items() if getattr(value, "__module__", "") == module_name]
        for name in getattr(module, "__all__", [name for name in own if not name.startswith("_")]):
            value, label = getattr(module, name), f"{module_name}.{name}"
            if inspect.isclass(value):
                yield label, None, value
                members = {method: one for method, one in vars(value).items() if not method.startswith("_")}
                yield from ((f"{label}.{method}", code, ()) for method, one in members.items() if (code := _code(one)))
            elif code := _code(value):
                yield label, code, ()


def _code(member: Any) -> CodeType | None:
    """Return the code of a function, a method or a property of this package."""
    if isinstance(member, property):
        member = member.fget
    function = inspect.unwrap(getattr(member, "__func__", getattr(member, "func", member)))
    found = getattr(function, "__code__", None)
    return found if getattr(function, "__module__", "").startswith("apex_ompl") else None


def _use_planner() -> None:
    """A kept planner, its world, and plans."""
    import apex_ompl
    from apex_ompl.planning.options import check_arguments
    from apex_ompl.planning.pool import kept_planner
    from apex_ompl.scene import OnPlane

    robot = apex_ompl.load_robot("dual_panda_softhand")
    home = robot.home
    assert len(robot.last_links) == 12
    with apex_ompl.MotionPlanner(robot) as planner:
        world = planner.world
        seen = apex_ompl.points_from_depth(np.full((8, 8), 2.0), (50.0, 50.0, 4.0, 4.0), np.eye(4))
        world.set_points("seen", apex_ompl.filter_points(seen + (0.0, 0.0, 1.0), robot, home), radius=0.01)
        world.add(name="ball", sphere={"radius": 0.03}, position=(0.5, 0.0, 1.0))
        world.move("ball", (0.6, 0.0, 1.0))
        world.set_velocity("ball", (0.0, 0.1, 0.0))
        world.set_velocity("ball", None)
        world.allow("ball", "left_link0")
        assert world.allowed and set(world.obstacles) == {"seen", "ball"} and not world.held
        with world.locked():
            world.attach("ball", "left_hand_palm", at=home)
            world.detach("ball", at=home)
        world.remove("ball")
        assert planner.is_free(home) and bool(planner.check(home)) and "1 obstacle" in repr(world)
        palm = robot.link_pose(home, "left_hand_palm")[:3, 3]
        pose = apex_ompl.PoseTarget(frame="left_hand_palm", position=tuple(palm + (0.0, 0.0, 0.02)))
        result = planner.plan(home, pose, timeout=20.0, timing=apex_ompl.Timing(velocity_scale=0.9))
        assert result and result.status is apex_ompl.PlanStatus.EXACT_SOLUTION
        assert len(result.path.sample(0.1)) > 1
        line = planner.plan_line(home, pose, frame="left_hand_palm", timeout=20.0)
        assert line and line.share == 1.0
        plane = OnPlane(frame="left_hand_palm", normal=(1.0, 0.0, 0.0))
        assert planner.plan(home, pose, timeout=20.0, constraints=[plane]).constraint_bound
        assert planner.simple_setup(home, home + 0.01) and planner.problem(home, home).name == "world"
        world.load(planner.problem(home, home))
        world.clear()
        assert planner.plan_problem(apex_ompl.load_problem("ball_in_cup"), "rrtconnect", timeout=20.0)
    for name in ("result.npz", "result.json", "result.yaml"):
        result.save(name)
        assert apex_ompl.PlanResult.load(name).as_dict() == result.as_dict()
    assert apex_ompl.plan("reach_past_post", timeout=20.0, params={"model": "apex"})
    assert apex_ompl.load_model("apex-paper") is not None
    with kept_planner("dual_panda_softhand") as kept:
        assert kept.robot.name == robot.name
    check_arguments(1.0, 0)
    try:
        planner.plan(home, home, timeout=-1.0)
    except apex_ompl.ApexError as error:
        assert "timeout" in str(error)


def _use_kinematics() -> None:
    """Inverse and forward kinematics, and paths of a user's own."""
    import apex_ompl
    from apex_ompl.planning import IKResult, IKSolution, ProofResult

    with apex_ompl.MotionPlanner("panda") as planner:
        home = planner.robot.home
        pose = apex_ompl.PoseTarget(frame="hand", position=tuple(planner.fk("home", "hand")[:3, 3]))
        found = planner.ik(pose, near="home", count=4)
        assert isinstance(found, IKResult) and found.states.shape == (4, 7) and len(found) == len(list(found)) == 4
        assert isinstance(found[0], IKSolution) and found[0].clearance > 0.0
        wanted = pose.model_copy(update={"orientation": (1.0, 0.0, 0.0, 0.0), "approach": (0.0, 0.0, 0.05)})
        grasps = planner.problem("home", apex_ompl.AnyOf([wanted]))
        assert grasps.goal.approaches and not wanted.before_approach.approach and wanted.is_exact
        assert planner.plan_task(grasps, timeout=20.0)
        assert isinstance(planner.prove([home, home]), ProofResult) and planner.checker.is_free(home)


def _use_tasks() -> None:
    """Tasks: the steps after a goal."""
    import apex_ompl
    from apex_ompl.planning import TaskSearch

    robot = apex_ompl.load_robot("dual_panda_softhand")
    task = apex_ompl.plan_task("stack_boxes", timeout=20.0)
    assert task and task.steps[-1].kind == "retreat" and task.step_at(0.0).kind == "goal"
    assert task.object_poses(robot, task.goal_time)["upper"] is not None
    task.save("task.npz")
    assert apex_ompl.TaskResult.load("task.npz").as_dict() == task.as_dict()
    assert len(apex_ompl.TaskResult.of_motion(task).steps) == 1
    with apex_ompl.MotionPlanner(robot) as planner:
        assert planner.plan_task(apex_ompl.load_problem("handover"), timeout=20.0)
    with apex_ompl.MotionPlanner("panda") as planner:
        assert (
            planner.sequence(
                "home", [{"kind": "wait", "seconds": 1.0}], search=TaskSearch(wanted=1), timeout=20.0
            ).goal_time
            == 0.0
        )


def _use_records() -> None:
    """Robots and problems."""
    import apex_ompl
    from apex_ompl.robot import Limits, robot_names

    for name in robot_names():
        robot = apex_ompl.load_robot(name)
        q = robot.random_state(np.random.default_rng(0))
        link = robot.link_names[-1]
        assert len(q) == robot.dof and robot.limit_fault(robot.within_limits(q)) is None
        assert robot.link_pose(q, link).shape == (4, 4) and robot.link_frame(link) >= 0
        assert robot.hand_of(link) and robot.part_of(link) and len(robot.to_pinocchio(q)) >= robot.dof
        assert isinstance(robot.limits, Limits)
    problem = apex_ompl.load_problem("ball_in_cup")
    alignment = apex_ompl.Alignment(kind="vertical", first="a", second="b")
    assert alignment.distance is None and not problem.moving and problem.still == problem and problem.source
    assert problem.start_state(apex_ompl.load_robot(problem.robot).joint_names).shape == (16,)
    assert problem.goal_states(apex_ompl.load_robot(problem.robot).joint_names).shape[1] == 16
    problem.save("problem.yaml")
    again = apex_ompl.Problem.load("problem.yaml")
    assert again.to_yaml() == problem.to_yaml() and apex_ompl.Problem.parse(again.as_dict(), "mine") == again


def _use_trajectories() -> None:
    """Time parameterization, and motions."""
    import apex_ompl
    from apex_ompl.timing import Sample, TimedPath, warm_up

    warm_up()
    robot = apex_ompl.load_robot("baxter")
    path = np.stack([robot.home, robot.home + 0.1, robot.home + np.eye(robot.dof)[0] * 0.2])
    timing = apex_ompl.Timing(method="spline", minimum_duration=1.0)
    timed = apex_ompl.time_path(path, robot.limits, robot.joint_names, timing)
    assert isinstance(timed, TimedPath) and timing.start(timing.limits(robot.limits, robot.joint_names)) is None
    motion = timed.trajectory
    assert motion.duration > 0.999 and motion.dof == robot.dof and max(motion.use(robot.limits).values()) <= 1.0 + 1e-9
    assert motion.jerk > 0.0 and motion.jerks.size and motion.spectral_arc_length < 0.0
    assert motion.states(motion.times).shape == (3, len(motion.times), robot.dof) and len(motion.knots) == 4
    assert isinstance(motion.sample(0.1), Sample) and len(list(motion.stream(100.0))) > 100
    assert motion.slower(2.0).duration > motion.after(0.5).duration
    stopped = motion.stop_at(0.3, robot.limits)
    assert stopped.duration < motion.duration and motion.merged() is motion
    rest = apex_ompl.time_path(np.stack([stopped.positions[-1], path[-1]]), robot.limits, robot.joint_names, timing)
    whole = apex_ompl.timing.joined([stopped, rest.trajectory])
    assert whole.deviation(whole.resampled(1000.0)) < 1e-3 and whole.before(0.1).duration == 0.1
    assert whole.smoothness(robot.limits).jerk.max() < 1.0
    assert whole.saved(rate=1000.0, joints=robot.joint_names[:2]).dof == whole.selected(robot.joint_names[:2]).dof == 2
    assert apex_ompl.Trajectory.unchecked(motion.times, motion.states(motion.times), motion.joint_names).duration
    for name in ("motion.npz", "motion.csv", "motion.traj.yaml", "motion.traj.json"):
        motion.save(name)
        assert abs(apex_ompl.Trajectory.load(name).duration - motion.duration) < 1e-8


def _use_problems() -> None:
    """Ready-made problems, suites and frozen problems, and planners by name."""
    from ompl import base as ob

    from apex_ompl import load_problem, planners, problems

    for name in problems.names():
        assert load_problem(name).name
    for suite, levels in problems.suites().items():
        assert problems.sample(suite, level=levels[0], seed=800_000).name
    (first, *_) = problems.frozen_names("shelf", "hard")
    assert problems.is_id(first) and problems.witness(first).path.shape[1] == 16
    assert problems.primitives(problems.load("unseen/wheels/800001"))
    for name in planners.names():
        assert name in planners.TUNED or planners.parameters(name) is not None
    assert planners.parameters("rrtconnect").changed(**{"range": 0.7}).range == 0.7
    space = ob.SpaceInformation(ob.RealVectorStateSpace(2))
    assert planners.make("rrt", space, range=0.1).getName() and planners.allocator("rrt")(space).getName()
    try:
        planners.Parameters().build(space)
    except TypeError as error:
        assert "does not say" in str(error)


def _use_ompl() -> None:
    """APEX in a SimpleSetup, and states of OMPL's."""
    import apex_ompl
    from apex_ompl.ompl import space
    from apex_ompl.planners import APEX

    setup = apex_ompl.setup("shelf_swap")
    si, robot = setup.getSpaceInformation(), apex_ompl.load_robot("dual_panda_softhand")
    low, high = space.bounds_of(si, robot)
    assert space.state_space(robot).getDimension() == robot.dof and (low <= high).all()
    assert np.array_equal(space.to_array(space.to_state(si, robot.home), robot.dof), robot.home)
    path = space.array_to_path(si, np.stack([robot.home, robot.home + 1e-3]))
    ends = space.path_to_array(path, robot.dof)
    assert space.motions_free(si, ends[:1], ends[1:]).shape == (1,)
    space.forget_states(ValueError("nothing"))
    planner = APEX(si)
    setup.setPlanner(planner)
    setup.setup()
    assert setup.solve(20.0).getStatus() and planner.report is not None
    setup.clear()


def _use_steps() -> None:
    """The five steps of a plan, and a goal sampler."""
    import apex_ompl
    from apex_ompl import planners, planning

    class Home(planning.GoalSampler):
        def sample(self, rng: np.random.Generator) -> Any:
            return planner.robot.home + 0.01 if super().sample(rng) is None else None

    with apex_ompl.MotionPlanner() as planner:
        assert planner.plan(planner.robot.home, Home(), timeout=20.0)

    chosen = planners.chosen("apex", {"first": 4}, seed=3)
    query = planning.check(planning.assemble(apex_ompl.load_problem("reach_past_post")), chosen, timeout=20.0)
    assert query and not query.ends_search() and not query.ends()
    found = planning.solve(query)
    proved = planning.prove(found)
    assert found.result().path is not None and proved and planning.time(proved)


def _use_run() -> None:
    """The closed loop, on its own clock and a driver's."""
    import apex_ompl
    from apex_ompl.drivers import KinematicDriver
    from apex_ompl.loop import Observation

    result = apex_ompl.run("popup/vertical/large/12", method="no-network")
    for name in ("run.npz", "run.json"):
        result.save(name)
        assert apex_ompl.RunResult.load(name).as_dict() == result.as_dict()
    problem = apex_ompl.load_problem("vertical/free/1")
    settings = apex_ompl.LoopSettings(error=0.01, fastest=0.3)
    ball = apex_ompl.Obstacle(name="ball", sphere={"radius": 0.05}, position=(1.5, 1.5, 1.0))
    with apex_ompl.Loop(problem, settings=settings) as loop:
        told = {"ball": ((0.1, 0.0, 0.0), 0.05)}
        clouds = {"camera": np.full((5, 3), 2.0)}
        loop.observe(0.0, [ball], errors={"ball": 1e-4 * np.eye(3)}, clouds=clouds, velocities=told)
        command = loop.step(0.0, problem.start_state(loop.joint_names))
        assert command is not None and command.rests and loop.outcome is None and loop.record is None
        assert loop.missed() is not None
        loop.abort("enough")
        assert loop.step(0.01) is not None and loop.outcome is not None and loop.reason == "enough"
        assert loop.events[-1].time <= 0.03
    with apex_ompl.Loop(problem, settings=settings) as loop:
        loop.end("at once")
        assert loop.outcome is not None and loop.reason == "at once"

    class Camera:
        def read(self, now: float) -> Observation:
            return Observation(now, now, (ball,))

    robot = apex_ompl.load_robot(problem.robot)
    driver = KinematicDriver(robot, problem.start_state(robot.joint_names))
    result = apex_ompl.run(problem, "no-network", settings=settings, sensor=Camera(), driver=driver)
    assert result.settings["driver"] == "KinematicDriver" and result.metrics["tracking_error"] < 1e-9


def _use_drivers() -> None:
    """Exact robots, one that writes a bag, and one by functions; docs/drivers.md uses that of physics."""
    import apex_ompl
    from apex_ompl.drivers import BagDriver, CombinedDriver, FrankaSettings, FunctionDriver, Guard, KinematicDriver

    robot = apex_ompl.load_robot("panda")
    goal = robot.home + 0.2 * (np.arange(robot.dof) == 0)
    motion = apex_ompl.time_path(np.stack([robot.home, goal]), robot.limits, robot.joint_names).trajectory
    for driver in (KinematicDriver(robot), BagDriver(robot, "bag")):
        driver.send(motion, 0.1)
        driver.advance(0.2)
        driver.stop()
        driver.advance(driver.end)
        assert not driver.state().velocities.any()
        driver.close()
    assert Path("bag/metadata.yaml").exists()
    pushed = KinematicDriver(robot, guard=Guard(tracking=0.02), joints=robot.joint_names[:4])
    pushed.push(np.full(4, 0.03))
    assert pushed.fault and np.abs(pushed.recover() - robot.home[:4] - 0.03).max() < 1e-9
    rest = FunctionDriver(robot, robot.joint_names[4:], lambda q: None, rate=500.0)
    whole = CombinedDriver(robot, [rest, KinematicDriver(robot, clock=lambda: rest.time, joints=robot.joint_names[:4])])
    whole.send(motion, whole.time + 0.05)
    whole.stop()
    assert not whole.fault
    whole.close()
    assert FrankaSettings(rate=500.0).lead == 0.02


def _use_perception() -> None:
    """Calibration of a camera by corners as they would be found; docs/perception.md uses cameras and frames."""
    import apex_ompl
    from apex_ompl.perception import (
        Board,
        Camera,
        DepthErrors,
        Frame,
        View,
        calibrate,
        load_frames,
        look_at,
        measured_depths,
    )

    robot, board = apex_ompl.load_robot("panda"), Board(columns=5, rows=4, square=0.03)
    camera = Camera(width=640, height=480, focal=(465.0, 465.0), center=(319.5, 239.5), depth=DepthErrors(noise=0.003))
    palm = robot.link_pose(robot.home, "panda_hand")
    eye = look_at(palm[:3, 3] + [0.8, 0.3, 0.4], palm[:3, 3])
    on_palm = np.linalg.inv(palm) @ np.block([[eye[:3, :3], palm[:3, 3:]], [np.zeros(3), 1.0]])
    rng, views = np.random.default_rng(0), []
    for _ in range(12):
        q = robot.within_limits(robot.home + rng.normal(0.0, 0.3, robot.dof))
        seen = np.linalg.inv(eye) @ robot.link_pose(q, "panda_hand") @ on_palm
        points = board.corners @ seen[:3, :3].T + seen[:3, 3]
        assert camera.projection_jacobian(points).shape == (20, 2, 3)
        views.append(View(q, camera.project(points)))
    found = calibrate(robot, camera, board, views, board_link="panda_hand")
    assert np.abs(found.camera.pose_at(robot, robot.home) - eye).max() < 1e-3
    assert found.corrected({"a": 1.0}) == {"a": 1.0}
    assert measured_depths(found, robot, board, [], board_link="panda_hand") is None
    assert board.find(np.full((480, 640, 3), 128, np.uint8)) is None
    found.camera.save("found.yaml")
    assert Camera.load("found.yaml") == found.camera and np.abs(camera.rays([319.5, 239.5])).max() < 1e-12
    frame = Frame(camera, np.ones((480, 640)), joints=dict(zip(robot.joint_names, robot.home.tolist(), strict=True)))
    frame.save("frame.npz")
    assert np.array_equal(load_frames("frame.npz")[0].state(robot.joint_names), robot.home)
    assert camera.points(Frame.load("frame.npz").depth).shape == (*camera.grid.shape[:2], 3)
    _use_map(camera.placed(eye))
    _use_messages(camera)
    _use_twin_camera(camera.placed(eye))
    _use_fits()


def _use_fits() -> None:
    """Held objects and an obstacle in a drawn scene, and the task that it shows."""
    import apex_ompl
    from apex_ompl.perception import (
        AlignSettings,
        DetectedObject,
        DetectionFit,
        DetectorSettings,
        HeldObjectFinder,
        HeldSettings,
        KnownSize,
        LookSettings,
        LookState,
        ObjectDetector,
        ObjectView,
        ObstacleFinder,
        ObstacleSettings,
        ObstacleTracker,
        SeenObstacle,
        SeenTask,
        Sight,
        TrackedObstacle,
        TrackerSettings,
        look_plan,
        look_states,
        see,
        vect_align,
    )
    from apex_ompl.perception.registration import corrected
    from apex_ompl.perception.surfaces import RobotSurface
    from apex_ompl.perception.synthetic import SceneGenerator, SyntheticSettings
    from apex_ompl.problems.objects import DATA
    from apex_ompl.scene.problem import Alignment

    robot = apex_ompl.load_robot("dual_panda_softhand")
    drawn = SceneGenerator(robot, DATA).draw(np.random.default_rng(0), SyntheticSettings(colors=True, obstacle="cube"))
    frame, attached = drawn.frames[0], [one.reported for one in drawn.objects]
    finder = HeldObjectFinder(robot, attached, HeldSettings())
    for one in (*finder.find(frame), *finder.by_grasp(frame)):
        assert one.face.shape == one.axis.shape == (3,) and one.face_covariance.shape == (3, 3)
        assert one.name and one.face_spread > 0.0 and one.axis_spread > 0.0
    assert frame.color is not None and len(finder.expected(robot.home)) == 2
    detector = ObjectDetector.load(settings=DetectorSettings(least_score=0.3))
    detected = detector.find(frame)
    bodies = {one.name: one for one in attached}
    assert len(DetectionFit(robot, bodies).refine(frame, detected)) <= len(detected)
    assert all(isinstance(one, DetectedObject) and one.pose.shape == (4, 4) for one in detected)
    obstacles = ObstacleFinder(ObstacleSettings())
    assert obstacles.colored(frame.color).any()
    given, tracker = corrected(frame, RobotSurface(robot), None), ObstacleTracker(TrackerSettings(births=1, of=1))
    found = obstacles.find(given, frame.color)
    for seen in found:
        assert isinstance(seen, SeenObstacle) and seen.place_spread > 0.0 and seen.obstacle("red", 1.0).name == "red"
    for tracked in tracker.update(frame.stamp, found, given):
        assert isinstance(tracked, TrackedObstacle) and tracked.place_covariance.shape == (3, 3)
        assert 0.0 < tracked.speed_deviation <= 0.2 + 1e-9
        assert tracked.obstacle(2.0).name == tracked.solid.name == tracked.name and not tracker.gone
        size = tracked.known_size()
        assert isinstance(size, KnownSize) and obstacles.find(given, frame.color, known=[size])
    alignment = Alignment(kind="vertical", first=attached[0].name, second=attached[1].name)
    task = vect_align(frame, robot, attached, alignment, AlignSettings(obstacles=None))
    assert isinstance(task, SeenTask) and bool(task) == (not task.reasons)
    looks = look_states(
        robot, attached, attached[0].name, frame.camera, frame.state(robot.joint_names),
        settings=LookSettings(proposals=8, predicted=2, rounds=1),
    )  # fmt: skip
    assert all(isinstance(one, LookState) and isinstance(one.objects[0], ObjectView) for one in looks)
    view = ObjectView(attached[0].name, 0.4, 1.0, 0.002, 0.01, "", True)
    shown = LookState(robot.home, frame.camera.name, (view,), 0.5)
    assert len(look_plan(looks)) <= 1 and look_plan((shown,)) == (shown,) and shown.names == (view.name,)
    sight = see([frame], robot, attached, alignment)
    assert isinstance(sight, Sight) and bool(sight) == (not sight.reasons) and len(sight.as_dict()["objects"]) == 2


def _use_map(camera: Any) -> None:
    """Occupied and unknown space before a wall; docs/perception.md has the rest."""
    import apex_ompl
    from apex_ompl.perception import OccupancyMap

    pose = camera.pose
    middle = pose[:3, 3] + 0.8 * pose[:3, 2]
    seen = OccupancyMap((middle - 0.2, middle + 0.2), 0.02)
    seen.integrate(np.full((480, 640), 0.8), camera)
    before = pose[:3, 3] + 0.7 * pose[:3, 2]
    assert seen.free.any() and seen.look_up([before]).tolist() == [-1] and len(seen.points()) == seen.occupied.sum()
    seen.decay(127)
    assert not seen.occupied.any()
    seen.clear()
    assert seen.unknown.all()
    robot = apex_ompl.load_robot("panda")
    own = OccupancyMap(((-0.2, -0.2, 0.0), (0.2, 0.2, 0.4)), 0.05, robot)
    assert own.touched(robot.home).any()


def _use_messages(camera: Any) -> None:
    """Messages that have the fields of those of ROS 2, and a bag without images."""
    from types import SimpleNamespace as Message

    from apex_ompl.errors import DriverError, MissingFileError, UnknownNameError
    from apex_ompl.perception import Ros2Camera, Synchronizer, bag_frames

    header = Message(stamp=Message(sec=1, nanosec=0))
    image = {"header": header, "height": 480, "width": 640, "is_bigendian": 0}
    together = Synchronizer()
    together.states(Message(header=header, name=["a"], position=[0.5]))
    together.color(Message(**image, encoding="mono8", step=640, data=bytes(640 * 480)))
    together.depth(Message(**image, encoding="16UC1", step=1280, data=bytes(2 * 640 * 480)))
    whole = Message(x_offset=0, y_offset=0)
    matrix = [465.0, 0.0, 319.5, 0.0, 465.0, 239.5, 0.0, 0.0, 1.0]
    about = Message(height=480, width=640, distortion_model="", d=[], k=matrix, roi=whole, binning_x=0, binning_y=0)
    together.info(about)
    (frame,) = together.ready()
    assert frame.camera.focal == camera.focal and frame.joints == {"a": 0.5}
    try:
        next(bag_frames("bag"))
    except UnknownNameError as error:
        assert "/joint_states" in str(error)
    node = Message(create_subscription=lambda *given: given, destroy_subscription=lambda one: None)
    try:
        over_ros = Ros2Camera(node, camera)
    except MissingFileError:
        return
    assert not over_ros.frames() and not over_ros.dropped
    try:
        over_ros.next(0.01)
    except DriverError as error:
        assert "no images" in str(error)
    over_ros.close()


def _use_twin_camera(camera: Any) -> None:
    """A camera in physics, where there is OpenGL."""
    import apex_ompl
    from apex_ompl.drivers import MujocoDriver
    from apex_ompl.errors import MissingFileError
    from apex_ompl.perception import TwinCamera

    twin_camera = TwinCamera(MujocoDriver(apex_ompl.load_robot("panda")), camera)
    try:
        assert twin_camera.frame().depth.any() and len(list(twin_camera.frames(0.1, 10.0))) == 2
    except MissingFileError as error:
        assert "OpenGL" in str(error) and twin_camera.frames(0.1, 10.0)
    twin_camera.close()
