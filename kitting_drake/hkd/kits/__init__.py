"""Kits: blocks with a conformal cavity for each tool."""
