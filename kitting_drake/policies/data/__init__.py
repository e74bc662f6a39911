"""Observations and actions to learn from: demonstrations, static scenes, labelled images."""
