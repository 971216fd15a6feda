"""Frames to table observations: semantics, clusters, edges, motion."""
