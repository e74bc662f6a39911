"""Kitting tasks: hand tools, and a kit with a cavity for each (section IV of the paper)."""
