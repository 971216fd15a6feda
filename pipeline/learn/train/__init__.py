"""Training: from table `training` to a run folder."""
