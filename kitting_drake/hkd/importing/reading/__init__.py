"""Readers of meshes and drawings, which tolerate the deviations of many programs."""
