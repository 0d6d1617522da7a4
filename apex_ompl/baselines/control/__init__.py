"""Reactive control over a short horizon: model predictive path integral control and an artificial potential field."""
