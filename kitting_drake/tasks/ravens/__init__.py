"""Tasks of the Ravens benchmark, for a parallel-jaw gripper (section V-B.2 of the paper)."""
