"""Generates the models of tools, from catalogue entries or at random."""
