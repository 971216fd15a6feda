"""The world along a road: meshes, traffic, and the rays that meet them."""
