"""Grasps that are measured on a tool's surface, or proposed from it."""
