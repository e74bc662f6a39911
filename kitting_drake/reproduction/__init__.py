"""Reproduces the paper's experiments: the command `benchmark`, and the pages of results."""
