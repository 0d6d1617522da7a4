"""OMPL: state space, validity checkers, planning setup, simplification, repair."""
