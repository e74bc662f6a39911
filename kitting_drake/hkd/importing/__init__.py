"""Importing: tools from meshes and outlines."""
