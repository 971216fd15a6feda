"""One moment of a vehicle-day in 3D, with open3d: see README.md."""
