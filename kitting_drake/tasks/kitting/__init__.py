"""Kitting: hand tools on a table, and a kit with a cavity for each (section IV)."""
