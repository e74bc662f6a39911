"""`hkd trace`: outlines of tools from a photo."""
