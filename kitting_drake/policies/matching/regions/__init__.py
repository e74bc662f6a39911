"""Finds the regions of o_t: fixtures, recesses and objects, and what of them is seen."""
