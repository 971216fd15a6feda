"""Method `tracking`, the paper's baseline: moving objects tracked by each sensor."""
