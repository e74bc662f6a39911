"""Splits a block into pieces that fit a printer's bed, joined by dovetails. Lengths in mm."""
