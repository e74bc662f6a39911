"""Robotic kitting in Drake: the cell, the tasks, the dataset and the policies."""
