"""Recordings of ROS: bags of ROS 1 and 2, MCAP files, and RealSense's."""
