"""Flat shapes to assemble in kits: our own, and a user's meshes."""
