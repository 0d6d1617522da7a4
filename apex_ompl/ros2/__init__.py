"""A node for ROS 2 beside the controllers of a robot: goals and obstacles come by topics, trajectories go out."""
