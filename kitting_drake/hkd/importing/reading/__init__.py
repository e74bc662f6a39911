"""Readers of mesh and drawing files, which accept common deviations from the file formats."""
