"""Calibrations of real cameras and their YAML layouts."""
