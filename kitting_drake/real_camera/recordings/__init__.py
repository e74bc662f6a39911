"""Reads recordings: bags of ROS 1 and ROS 2, MCAP files, and RealSense's recordings."""
