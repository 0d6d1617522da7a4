"""The closed loop: a robot that moves among obstacles that it observes, and plans anew while it moves."""
