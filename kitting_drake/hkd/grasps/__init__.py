"""Grasps: measured and proposed from a tool's surface."""
