"""Calibrations of real cameras, in the YAML layouts of several tools."""
