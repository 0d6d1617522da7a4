"""Tasks: alignment goals, grasps, inverse kinematics, MoveIt files."""
