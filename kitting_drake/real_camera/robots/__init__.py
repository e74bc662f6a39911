"""The arm of a bench, and files of its trajectories."""
