"""Robotic kitting in Drake: the cell, the tasks, the dataset and the policies."""

__version__ = "0.1.0"
