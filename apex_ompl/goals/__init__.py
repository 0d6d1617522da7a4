"""Goals: alignments, poses, grasps, and inverse kinematics."""
