"""Grasps: proposed and annotated."""
