"""Kits for printing and cutting: the files that `hkd kit` writes."""
