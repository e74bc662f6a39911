"""Makes tools from meshes and outlines (`hkd import`)."""
