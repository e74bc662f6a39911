"""Decisions by geometry: segmentation of the heightmap o_t, registration of outlines, and jaw
clearance."""
