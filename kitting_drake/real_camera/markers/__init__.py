"""Finds poses of cameras from a board of markers that lies on the table."""
