"""Kinematics of the robot's joints and spheres, bounds on their motion, and inverse kinematics."""
