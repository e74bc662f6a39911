"""Flat shapes to assemble in kits: the project's own shapes, and a user's meshes."""
