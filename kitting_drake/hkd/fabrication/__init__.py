"""Kits to print and to cut: solids, drawings and all else that `hkd kit` writes."""
