"""Decisions by geometry: segmentation of o_t, registration of outlines, jaw clearance."""
