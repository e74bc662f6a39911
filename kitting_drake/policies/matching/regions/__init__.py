"""Finds the regions of o_t: fixtures, recesses and objects. Also finds which parts are seen."""
