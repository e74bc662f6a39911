"""The robot arm of a real bench, and the files of its trajectories."""
