"""Extrinsics as values: priors, estimates of pairs, solutions."""
