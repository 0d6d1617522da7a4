"""A model in MuJoCo of a robot with its fixtures, the obstacles of a problem, and the objects that it holds.

Kinematics, masses and inertias of the links are those of the URDF, and geometry that of the collision checker. Pairs of
links that the checker does not check do not collide. Bodies that a problem allows to touch do touch here; a pair whose
shapes overlap at the start would be pushed apart, and passes through. Joints that mimic others follow them by equality
constraints. The
motors of the planned joints are driven by torque, and compensate the gravity of the links. The effort of
a robot file limits the torque at the link, as the limits of a Panda do, whose sensors are behind the gears: what the
rotor and the friction of a joint need at its limits of acceleration and velocity, its motor gives in addition. Held
objects are free bodies, welded to the link that holds them.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from itertools import combinations, count
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.collision.mass import held_load
from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.constraints.frames import holding_link
from apex_ompl.drivers.geoms import geom_shapes
from apex_ompl.drivers.jaws import RIGID, add_jaws, set_jaws
from apex_ompl.drivers.library import mujoco
from apex_ompl.drivers.twin_settings import (
    LEADER_ARMATURE,
    LEADER_DAMPING,
    LEAST_INERTIA,
    LEAST_MASS,
    Mimic,
    TwinSettings,
    held_loads,
    mimic_joints,
    payloads,
    servo_gains,
    with_mass,
)
from apex_ompl.errors import RobotError
from apex_ompl.robot.dynamics import Load
from apex_ompl.robot.model import Robot, link_of
from apex_ompl.scene.bodies import AttachedObject, Body, Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import is_there, place_at
from apex_ompl.scene.steps import AttachStep, parts
from apex_ompl.types import Array
from apex_ompl.util.validation import check_name

FOLLOWER_ARMATURE, FOLLOWER_DAMPING = 1e-4, 5e-3  # of joints that mimic others
FINGER_DAMPING = 0.01  # of the springs by which fingers yield [Nm s/rad]
SOFT_CONTACT = {"solref": [0.004, 1.0], "solimp": [0.95, 0.99, 0.001, 0.5, 2.0]}
SOLIDS, FALLING = 1, 2  # bits by which geoms collide: the floor is touched by held objects only
GONE = 8  # by how much these bits are shifted of bodies that are gone
OVERLAP = 0.005  # of a pair that may touch, at the start, from which on it passes through each other [m]
AWAY = np.array([0.0, 0.0, -1000.0])  # where obstacles are that have not appeared [m]
COLORS = {
    "link": (0.85, 0.86, 0.88, 1.0), "fixture": (0.79, 0.65, 0.49, 1.0), "obstacle": (0.78, 0.33, 0.24, 1.0),
    "held": (0.16, 0.62, 0.56, 1.0), "floor": (0.93, 0.93, 0.91, 1.0),
}  # fmt: skip


class Twin:
    """A compiled model, and where the joints, motors and bodies of the robot and the problem are in it.

    Attributes:
        robot: The robot.
        problem: The problem, or None.
        settings: The settings.
        mimics: Joints that mimic others.
        loads: Masses that the robot holds, for inverse dynamics.
        held: Held objects.
        moving: Obstacles that move or appear.
        model: The ``MjModel``.
        q: Places of the planned joints in ``qpos``, shape (dof,).
        v: The same in ``qvel``.
        u: The same in ``ctrl``.
        kp: Stiffness of the servos, shape (dof,) [Nm/rad].
        kd: Damping of the servos, shape (dof,) [Nm s/rad].
        motor_torque: Largest torques of the motors, shape (dof,) [Nm].
        names: Names of the bodies in their order.
    """

    def __init__(self, robot: Robot, problem: Problem | None = None, settings: TwinSettings | None = None) -> None:
        """Build the model.

        Raises:
            MissingFileError: The extra ``twin`` is not installed, or the file of a shape cannot be read.
            UnknownNameError: There is no joint of the gains, or no link that holds an object or a payload.
            SceneError: A shape has no counterpart in MuJoCo.
            RobotError: MuJoCo cannot make a model of the robot, or one without all mimic joints.
        """
        self._mj, self._numbers = mujoco(), count()
        self.robot, self.problem, self.settings = robot, problem, settings or TwinSettings()
        self.mimics = mimic_joints(robot.urdf)
        scene = problem.scene if problem else ()
        self.held: tuple[AttachedObject, ...] = problem.attached if problem else ()
        self.moving: tuple[Obstacle, ...] = tuple(one for one in scene if one.moving)
        self.loads = held_loads(robot, problem, self.settings) if problem else ()
        spec = self._spec(scene)
        self.model = model = self._compiled(spec)
        joints = [model.joint(name) for name in robot.joint_names]
        self.q = np.array([joint.qposadr[0] for joint in joints])
        self.v = np.array([joint.dofadr[0] for joint in joints])
        self.u = np.array([model.actuator(name).id for name in robot.joint_names])
        gains = servo_gains(robot, self.settings)
        self.kp, self.kd = np.array([gains[name] for name in robot.joint_names]).T
        self.names = tuple(str(model.body(k).name) for k in range(model.nbody))
        self._followers = np.array([model.joint(one.joint).qposadr[0] for one in self.mimics], np.intp)
        self._leaders = np.array([model.joint(one.leader).qposadr[0] for one in self.mimics], np.intp)
        self._line = np.array([(one.multiplier, one.offset) for one in self.mimics]).reshape(-1, 2)
        self._mocap = {one.name: int(model.body(one.name).mocapid[0]) for one in self.moving}
        limited = model.jnt_actfrclimited[[joint.id for joint in joints]].astype(bool)
        self.motor_torque = np.where(limited, model.jnt_actfrcrange[[joint.id for joint in joints], 1], np.inf)
        self._compensated = model.jnt_actgravcomp[[joint.id for joint in joints]].astype(float)
        if overlapping := self._overlapping():
            _exclude(spec, overlapping)
            self.model = self._compiled(spec)

    @property
    def yields(self) -> bool:
        """Whether fingers yield, and held objects collide with the hands that hold them."""
        return self.settings.finger_stiffness is not None

    def welded_to(self, held: AttachedObject) -> tuple[str, ...]:
        """Return the links that an object can be welded to: its holder, and where fingers yield any palm.

        To these come the links that steps of the problem attach it to. An object that no link may touch stands on
        another one where fingers yield, and is not welded.
        """
        if not self.yields:
            return (held.link,)
        palms = [hand.palm for hand in self.robot.hands.values()]
        steps = parts(self.problem.after) if self.problem else ()
        taking = [one for one in steps if isinstance(one, AttachStep) and one.object == held.name]
        links = (held.link, *palms, *(holding_link(self.robot, one.link) for one in taking))
        return () if held.touch_links == () else tuple(dict.fromkeys(links))

    def weld(self, data: Any, name: str, link: str, active: bool = True) -> None:
        """Weld a held object to a link where it is now, or cut that weld.

        Raises:
            UnknownNameError: There is no such object, or no weld between them.
        """
        check_name(f"{name} {link}", "weld", [self.model.equality(k).name for k in range(self.model.neq)])
        equality, palm, body = self.model.equality(f"{name} {link}"), data.body(link), data.body(name)
        inverse, turn, offset, place = np.empty(4), np.empty(4), np.empty(3), np.empty(3)
        self._mj.mju_negPose(place, inverse, palm.xpos, palm.xquat)
        self._mj.mju_mulPose(offset, turn, place, inverse, body.xpos, body.xquat)
        equality.data[3:10] = [*offset, *turn]
        data.eq_active[equality.id] = active

    def remove(self, name: str, gone: bool = True) -> None:
        """Let a body touch nothing, without weight and unseen, or bring it back.

        Raises:
            UnknownNameError: There is no such body.
        """
        check_name(name, "body", self.names)
        model, body = self.model, self.model.body(name).id
        mine = model.geom_bodyid == body
        for bits in (model.geom_contype, model.geom_conaffinity):  # those of a body that is gone are shifted up
            bits[mine] = bits[mine] << GONE if gone else bits[mine] >> GONE
        for bits in (model.body_contype, model.body_conaffinity):
            bits[body] = bits[body] << GONE if gone else bits[body] >> GONE
        model.geom_rgba[mine, 3] = 0.0 if gone else 1.0
        model.body_gravcomp[body] = 1.0 if gone else 0.0

    def grip(self, data: Any, hand: str, closed: bool) -> None:
        """Close or open the jaws of a hand, where fingers yield; a hand without jaws stays as it is."""
        if self.yields:
            set_jaws(self.model, data, self.robot, hand, closed)

    def forces(self, data: Any, name: str) -> dict[str, Array]:
        """Return the forces of other bodies on a body by their names, in the world, each of shape (3,) [N]."""
        found: dict[str, Array] = {}
        owner, force = self.model.body(name).id, np.empty(6)
        for k, contact in enumerate(data.contact):
            first, second = (int(self.model.geom_bodyid[geom]) for geom in contact.geom)
            if owner not in (first, second):
                continue
            self._mj.mj_contactForce(self.model, data, k, force)
            other, sign = (self.names[first], 1.0) if second == owner else (self.names[second], -1.0)
            found[other] = found.get(other, np.zeros(3)) + sign * contact.frame.reshape(3, 3).T @ force[:3]
        return found

    @property
    def rotor_inertia(self) -> Array:
        """Inertia of rotors at each planned joint, with those of joints that mimic it, shape (dof,) [kg m^2]."""
        return self._with_followers(self.model.dof_armature)

    @property
    def friction(self) -> Array:
        """Viscous friction of each planned joint, with that of joints that mimic it, shape (dof,) [Nm s/rad]."""
        damping = self.model.dof_damping
        return self._with_followers(damping if damping.ndim == 1 else damping[:, 0])

    def _with_followers(self, values: Array) -> Array:
        found = np.array(values[self.v])
        for one in self.mimics:
            k = self.robot.joint_names.index(one.leader)
            found[k] += one.multiplier**2 * values[self.model.joint(one.joint).dofadr[0]]
        return found

    def data(self, state: Array, time: float = 0.0) -> Any:
        """Return an ``MjData`` with the robot at rest in a state, shape (dof,), with what it holds, at a time [s]."""
        data = self._mj.MjData(self.model)
        self.place(data, state, time)
        return data

    def place(self, data: Any, state: Array, time: float = 0.0) -> None:
        """Put the robot into a state, shape (dof,), with what it holds, and the obstacles to a time [s]."""
        data.time, data.qvel[:] = time, 0.0
        data.qpos[self.q], data.ctrl[self.u] = state, 0.0
        data.qpos[self._followers] = self._line[:, 0] * data.qpos[self._leaders] + self._line[:, 1]
        for hand in self.robot.hands:
            self.grip(data, hand, False)
        for one in self.held:
            self._set_free(data, one.name, self.robot.link_pose(state, one.link) @ one.pose)
        self.move_obstacles(data, time)
        self._mj.mj_forward(self.model, data)

    def move_obstacles(self, data: Any, time: float) -> None:
        """Put the obstacles that move to where they are at a time [s]; those that have not appeared are far below."""
        for one in self.moving:
            data.mocap_pos[self._mocap[one.name]] = place_at(one, time) if is_there(one, time) else AWAY

    def step(self, data: Any) -> None:
        """Simulate one step."""
        self._mj.mj_step(self.model, data)

    def asked_torques(self, data: Any) -> Array:
        """Return the torques that the motors and the compensation of gravity ask for, shape (dof,) [Nm]."""
        return np.asarray(data.actuator_force[self.u] + self._compensated * data.qfrc_gravcomp[self.v])

    def renderer(self, width: int, height: int) -> Any:
        """Return a ``mujoco.Renderer``."""
        size = self.model.vis.global_
        size.offwidth, size.offheight = max(size.offwidth, width), max(size.offheight, height)
        return self._mj.Renderer(self.model, height, width)

    def camera(self, azimuth: float, elevation: float, distance: float, center: Sequence[float]) -> Any:
        """Return a camera that looks at a point [m] from a distance [m], by angles in degrees."""
        camera = self._mj.MjvCamera()
        camera.azimuth, camera.elevation, camera.distance, camera.lookat[:] = azimuth, elevation, distance, center
        return camera

    def pose(self, data: Any, name: str) -> Array:
        """Return the pose of a link, an obstacle or a held object in the world, shape (4, 4) [m].

        Raises:
            UnknownNameError: There is no such body.
        """
        check_name(name, "body", self.names)
        found = np.eye(4)
        body = data.body(name)
        found[:3, :3], found[:3, 3] = body.xmat.reshape(3, 3), body.xpos
        return found

    def contacts(self, data: Any) -> dict[tuple[str, str], float]:
        """Return the pairs of bodies that touch by their names, and how deep [m]; the floor is ``world``.

        Those that the problem allows are among them.
        """
        if not data.ncon:
            return {}
        found: dict[tuple[str, str], float] = {}
        bodies = self.model.geom_bodyid[data.contact.geom]
        for (first, second), distance in zip(bodies.tolist(), data.contact.dist.tolist(), strict=True):
            a, b = sorted((self.names[first], self.names[second]))
            found[a, b] = max(found.get((a, b), 0.0), -distance)
        return found

    def _set_free(self, data: Any, name: str, pose: Array) -> None:
        at = self.model.joint(name).qposadr[0]
        data.qpos[at : at + 3], data.qpos[at + 3 : at + 7] = pose[:3, 3], _quaternion(pose)

    def _spec(self, scene: Sequence[Obstacle]) -> Any:
        """Return the model before it is compiled."""
        spec = self._skeleton()
        self._add_links(spec)
        self._add_joints(spec)
        self._coupled = add_jaws(self._mj, spec, self.robot) if self.yields else 0
        for fixture in self.robot.fixtures:
            self._add_static(spec, fixture, "fixture")
        for obstacle in scene:
            self._add_static(spec, obstacle, "obstacle")
        for held in self.held:
            self._add_held(spec, with_mass(held, self.settings.density))
        for load in payloads(self.robot, self.problem) if self.problem else ():
            self._add_payload(spec, load)
        self._add_exclusions(spec)
        self._add_surroundings(spec)
        return spec

    def _compiled(self, spec: Any) -> Any:
        try:
            model = spec.compile()
        except ValueError as error:
            reason = " ".join(str(error).split())
            raise RobotError(f"MuJoCo cannot make a model of {self.robot.name} ({reason})") from error
        joints = int(np.sum(model.eq_type == self._mj.mjtEq.mjEQ_JOINT)) + model.ntendon
        if joints - self._coupled != len(self.mimics):
            raise RobotError(f"MuJoCo has {joints} equalities for the {len(self.mimics)} mimic joints of the URDF")
        return model

    def _skeleton(self) -> Any:
        """Return the links and joints of the URDF, without geometry."""
        root = ET.fromstring(self.robot.urdf)
        for link in root.findall("link"):
            for kind in ("visual", "collision"):
                for element in link.findall(kind):
                    link.remove(element)
        mj = self._mj
        try:
            spec = mj.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
        except ValueError as error:
            raise RobotError(f"MuJoCo cannot read the URDF of {self.robot.name} ({error})") from error
        spec.compiler.fusestatic = False  # else links on fixed joints vanish
        spec.compiler.discardvisual = False  # else the background does
        spec.compiler.inertiafromgeom = mj.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
        option = spec.option
        option.timestep, option.integrator = self.settings.step, mj.mjtIntegrator.mjINT_IMPLICITFAST
        option.cone, option.impratio = mj.mjtCone.mjCONE_ELLIPTIC, 10.0  # else grasped objects creep
        option.disableflags |= mj.mjtDisableBit.mjDSBL_FILTERPARENT  # the robot's own pairs count
        return spec

    def _add_links(self, spec: Any) -> None:
        """Add the geometry of the links, and masses of moving links that have none."""
        robot, frames = self.robot, self.robot.model.frames
        for item in robot.geometry.geometryObjects:
            frame = frames[item.parentFrame]
            pose = (frame.placement.inverse() * item.placement).homogeneous
            self._add_geoms(spec, spec.body(frame.name), item.geometry, pose, "link")
        for body in spec.bodies:
            body.gravcomp = 1.0
            if list(body.joints) and not body.mass > 0.0:
                body.mass, body.inertia, body.explicitinertial = LEAST_MASS, [LEAST_INERTIA] * 3, True
                body.ipos = np.zeros(3)

    def _add_joints(self, spec: Any) -> None:
        """Set up joints, motors and the equalities of mimic joints."""
        mj, settings, robot = self._mj, self.settings, self.robot
        for name in settings.gains:
            check_name(name, "joint", robot.joint_names)
        for equality in list(spec.equalities):  # some versions make them of a URDF, some do not
            spec.delete(equality)
        leaders, followers = {one.leader for one in self.mimics}, {one.joint for one in self.mimics}
        effort = dict(zip(robot.joint_names, robot.effort.tolist(), strict=True))
        for joint in spec.joints:
            name = joint.name
            joint.armature, damping = settings.armature, settings.damping
            if name in leaders:
                joint.armature, damping = LEADER_ARMATURE, LEADER_DAMPING
            elif name in followers:
                joint.armature, damping = FOLLOWER_ARMATURE, FOLLOWER_DAMPING
            joint.damping = [damping, 0.0, 0.0] if np.ndim(joint.damping) else damping
            yields = name in leaders and settings.finger_stiffness is not None
            joint.actfrclimited = int(yields or math.isfinite(effort.get(name, math.inf)))
            joint.limited = int(name in effort)
            if name not in effort:
                continue
            k = robot.joint_names.index(name)
            own = joint.armature * robot.limits.acceleration[k] + damping * robot.limits.velocity[k]
            most = settings.grip if yields else effort[name] + own if joint.actfrclimited else 0.0
            joint.actfrcrange = [-most, most]
            joint.actgravcomp = name not in leaders
            spec.add_actuator(name=name, trntype=mj.mjtTrn.mjTRN_JOINT, target=name)  # a motor of gear 1
        for one in self.mimics:
            if settings.finger_stiffness is not None:
                self._add_spring(spec, one, settings.finger_stiffness)
                continue
            line = [one.offset, one.multiplier, 0.0, 0.0, 0.0]
            added = spec.add_equality(name=one.joint, type=mj.mjtEq.mjEQ_JOINT, objtype=mj.mjtObj.mjOBJ_JOINT)
            added.name1, added.name2, added.data[:5] = one.joint, one.leader, line
            added.solref, added.solimp = RIGID["solref"], RIGID["solimp"]

    def _add_spring(self, spec: Any, mimic: Mimic, stiffness: float) -> None:
        """Let a joint follow another one by a spring on its distance from where it mimics it."""
        tendon = spec.add_tendon(name=mimic.joint)
        for name, value in (("stiffness", stiffness), ("damping", FINGER_DAMPING)):
            setattr(tendon, name, [value, 0.0, 0.0] if np.ndim(getattr(tendon, name)) else value)
        tendon.springlength = [mimic.offset, mimic.offset]
        tendon.wrap_joint(mimic.joint, 1.0)
        tendon.wrap_joint(mimic.leader, -mimic.multiplier)

    def _add_static(self, spec: Any, body: Body, role: str) -> None:
        """Add a fixture or an obstacle; one that moves or appears is a mocap body."""
        added = spec.worldbody.add_body(name=body.name, pos=body.position, quat=_quaternion(body.pose))
        added.mocap = isinstance(body, Obstacle) and body.moving
        self._add_geoms(spec, added, coal_geometry(body), np.eye(4), role)

    def _add_held(self, spec: Any, held: AttachedObject) -> None:
        """Add a held object: a free body, welded to the link that holds it."""
        mj = self._mj
        self.robot.link_frame(held.link)
        added = spec.worldbody.add_body(name=held.name)
        added.add_freejoint(name=held.name)
        load = held_load(held.model_copy(update={"position": (0.0, 0.0, 0.0), "orientation": (0.0, 0.0, 0.0, 1.0)}))
        assert load is not None
        added.mass, added.ipos, added.explicitinertial = load.mass, load.center, True
        added.fullinertia = load.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        self._add_geoms(spec, added, coal_geometry(held), np.eye(4), "held")
        for link in self.welded_to(held):
            weld = spec.add_equality(name=f"{held.name} {link}", type=mj.mjtEq.mjEQ_WELD, objtype=mj.mjtObj.mjOBJ_BODY)
            weld.name1, weld.name2, weld.active = link, held.name, link == held.link
            weld.data[:11] = [0.0, 0.0, 0.0, *held.position, *_quaternion(held.pose), 1.0]
            weld.solref, weld.solimp = RIGID["solref"], RIGID["solimp"]

    def _add_payload(self, spec: Any, load: Load) -> None:
        """Add the mass of a payload, which has no shape."""
        added = spec.body(load.link).add_body(name=f"payload {next(self._numbers)}", pos=load.center)
        added.mass, added.inertia, added.explicitinertial = load.mass, np.diag(load.inertia), True
        added.ipos = np.zeros(3)  # else it counts twice

    def _add_geoms(
        self, spec: Any, body: Any, geometry: coal.CollisionGeometry, pose: Array, role: str
    ) -> None:  # fmt: skip
        friction, bits = [self.settings.friction, 0.01, 0.001], SOLIDS | FALLING if role == "held" else SOLIDS
        for shape in geom_shapes(geometry, pose, body.name):
            geom = body.add_geom(type=getattr(self._mj.mjtGeom, f"mjGEOM_{shape.kind}"))
            geom.pos, geom.quat, geom.rgba = shape.pose[:3, 3], _quaternion(shape.pose), COLORS[role]
            geom.contype, geom.conaffinity = SOLIDS, bits
            geom.friction, geom.condim = friction, 4
            if body.name in self.settings.frictionless:
                geom.condim, geom.priority = 1, 1  # which counts for both bodies of a contact
            geom.solref, geom.solimp = SOFT_CONTACT["solref"], SOFT_CONTACT["solimp"]
            geom.size[: len(shape.size)] = shape.size
            if shape.vertices is not None:
                geom.meshname = f"mesh {next(self._numbers)}"
                spec.add_mesh(name=geom.meshname, uservert=shape.vertices.ravel())

    def _add_exclusions(self, spec: Any) -> None:
        """Exclude the pairs that the checker does not check: of the robot and of held objects.

        Of those that the problem allows these are pairs of links, whose shapes are wider than the links at joints.
        """
        robot, model = self.robot, self.robot.model
        items = list(robot.geometry.geometryObjects)
        links = [link_of(model, item) for item in items]
        checked = {frozenset((links[pair.first], links[pair.second])) for pair in robot.geometry.collisionPairs}
        pairs = {frozenset(pair) for pair in combinations(sorted(set(links)), 2)} - checked
        for held in self.held if not self.yields else ():
            own = [link for link in held.touch_links or () if link in links]
            for holder in held.holders if held.touch_links is None else ():
                own += robot.hand_of(holder)
            pairs |= {frozenset((held.name, link)) for link in own}
        for one, other in combinations(self.held, 2):
            if not self.yields and _joint_of(robot, one.link) == _joint_of(robot, other.link):
                pairs.add(frozenset((one.name, other.name)))
        _exclude(spec, pairs | {pair for pair in self._allowed() if pair <= set(robot.link_names)})

    def _allowed(self) -> set[frozenset[str]]:
        """Return the pairs that the problem allows to touch."""
        return {frozenset(pair) for pair in (self.problem.allowed if self.problem else ()) if len(set(pair)) == 2}

    def _overlapping(self) -> set[frozenset[str]]:
        """Return the pairs that may touch and overlap at the start of the problem."""
        allowed = self._allowed()
        if self.problem is None or not allowed:
            return set()
        touching = self.contacts(self.data(self.problem.start_state(self.robot.joint_names)))
        return allowed & {frozenset(pair) for pair, depth in touching.items() if depth > OVERLAP}

    def _add_surroundings(self, spec: Any) -> None:
        """Add the floor, light and background."""
        floor = spec.worldbody.add_geom(name="floor", type=self._mj.mjtGeom.mjGEOM_PLANE)
        floor.size, floor.pos, floor.rgba = [3.0, 3.0, 0.1], [0.0, 0.0, self.settings.floor], COLORS["floor"]
        floor.contype, floor.conaffinity, floor.condim = FALLING, 0, 4
        mj = self._mj
        light = spec.worldbody.add_light(pos=[1.0, -1.0, 3.0], dir=[-0.3, 0.3, -1.0])
        light.type, light.diffuse = mj.mjtLightType.mjLIGHT_DIRECTIONAL, [0.5, 0.5, 0.5]
        spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.4, 0.4, 0.4], [0.35, 0.35, 0.35]
        spec.visual.headlight.specular = [0.0, 0.0, 0.0]
        sky = spec.add_texture(name="sky", type=mj.mjtTexture.mjTEXTURE_SKYBOX, width=64, height=64)
        sky.builtin, sky.rgb1, sky.rgb2 = mj.mjtBuiltin.mjBUILTIN_GRADIENT, COLORS["floor"][:3], COLORS["floor"][:3]
        spec.visual.quality.numslices, spec.visual.quality.numstacks = 64, 32


def _exclude(spec: Any, pairs: Iterable[frozenset[str]]) -> None:
    for first, second in sorted(sorted(pair) for pair in pairs):
        spec.add_exclude(bodyname1=first, bodyname2=second)


def _joint_of(robot: Robot, link: str) -> int:
    return int(robot.model.frames[robot.link_frame(link)].parentJoint)


def _quaternion(pose: Array) -> list[float]:
    """Return the rotation of a pose as a quaternion wxyz, as MuJoCo has it."""
    turn = pin.Quaternion(pose[:3, :3]).normalized()
    return [turn.w, turn.x, turn.y, turn.z]
