"""A cell: a Panda takes a box with any of many grasps, puts it onto a shelf, and goes home, as one proved motion."""

import numpy as np
import pinocchio as pin

import apex_ompl

FLOOR, SHELF = (0.8, 1.2, 0.02), (0.3, 0.3, 0.02)
DOWN = pin.rpy.rpyToMatrix(np.pi, 0.0, 0.0)  # the gripper from above

grasps = []
for turn in np.arange(4) * np.pi / 2:
    for tilt in (0.0, -0.4, -0.8, -1.2):
        rotation = pin.rpy.rpyToMatrix(0.0, 0.0, turn) @ DOWN @ pin.rpy.rpyToMatrix(0.0, tilt, 0.0)
        grasps.append({"position": (0, 0, 0.03), "orientation": pin.Quaternion(rotation).coeffs().tolist()})
onto_shelf = apex_ompl.PoseTarget(
    frame="box", position=(0.5, 0.35, 0.3002), orientation=(0, 0, 0, 1), free_turn="z", approach=(0, 0, -0.03)
)
steps = [
    {"kind": "move", "goal": {"grasp": {"object": "box", "hand": "hand", "approach": (0, 0, 0.1)}}},
    {"kind": "allow", "pairs": [("box", "floor"), ("box", "shelf")]},
    {"kind": "grasp", "hand": "hand", "object": "box"},
    {"kind": "line", "frame": "hand", "by": (0, 0, 0.1), "blend": 0.05},
    {"kind": "move", "goal": onto_shelf},
    {"kind": "release", "hand": "hand"},
    {"kind": "retreat", "hand": "hand", "distance": 0.1, "blend": 0.05},
    {"kind": "move", "goal": "home"},
]

with apex_ompl.MotionPlanner("panda") as planner:
    planner.world.add(name="floor", box=FLOOR, position=(0.6, 0.0, -0.01))
    planner.world.add(name="shelf", box=SHELF, position=(0.5, 0.35, 0.24))
    planner.world.add(name="roof", box=SHELF, position=(0.5, 0.35, 0.48))
    planner.world.add(name="box", box=(0.05, 0.05, 0.1), position=(0.5, -0.2, 0.05), grasps=grasps)
    result = planner.sequence("home", steps, timeout=30.0)
    print(result)
    result.save("cell.npz")  # apex-ompl view cell.npz
