"""Calibrations of real cameras, and the YAML layouts they are read from."""
