"""Reads frames of real cameras from files of many kinds."""

from kitting_drake.real_camera.frames.frame import Frame, check_frame
from kitting_drake.real_camera.frames.frame_reading import read_frames

__all__ = ["Frame", "check_frame", "read_frames"]
