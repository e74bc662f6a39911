"""Policies: their demonstrations, networks and losses. Nothing here imports pydrake."""
