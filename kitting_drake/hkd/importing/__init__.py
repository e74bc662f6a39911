"""Importing: tools from meshes of any origin."""
