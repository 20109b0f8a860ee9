"""Procedural tomato plants as triangle meshes."""
