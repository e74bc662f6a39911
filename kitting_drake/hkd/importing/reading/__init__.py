"""Reads meshes and drawings as their many programs write them."""
