"""Robotic kitting in Drake: the station, the tasks, the dataset and the policies."""

__version__ = "0.1.0"
