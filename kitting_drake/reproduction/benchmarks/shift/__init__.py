"""Simulated shifts: running them, their summary and report."""
