"""Hand tools: their records, solids, meshes and physical properties."""
