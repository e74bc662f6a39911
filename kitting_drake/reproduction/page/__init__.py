"""Generates the pages of results from result files."""
