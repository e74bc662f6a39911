"""Summaries, tables and figures of results."""
