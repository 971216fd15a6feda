"""Shared numerics of the methods: searches, response surfaces, covariance, bias floors."""
