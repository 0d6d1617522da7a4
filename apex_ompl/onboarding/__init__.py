"""Training of a model for a new robot: its problems, its data set, the networks, and what their proposals gain."""
