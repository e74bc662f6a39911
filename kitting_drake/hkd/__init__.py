"""The Hand-tool Kitting Dataset: tools, kits and grasps (section IV of the paper)."""
