"""Generates tools from catalogue entries or at random."""
