"""The world along a road: meshes, traffic, and ray casting."""
