"""Policies, their training data, networks and training. Nothing here imports pydrake."""
