"""The only place that touches tables."""
