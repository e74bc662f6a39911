"""Checks of real cameras by an empty table or a block of known size."""
