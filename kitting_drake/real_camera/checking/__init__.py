"""Checks of real cameras against an empty table, or a block of known size."""
