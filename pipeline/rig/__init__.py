"""The rig as a graph: sensors, the edges between them, and their poses."""
