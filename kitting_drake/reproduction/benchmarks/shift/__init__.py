"""Simulated work shifts: runs them, and reports on them."""
