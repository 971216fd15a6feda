"""Control charts over day estimates, and which sensor moved."""
