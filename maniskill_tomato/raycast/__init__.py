"""Triangles on a device and what rays, spheres and cameras meet of them."""
