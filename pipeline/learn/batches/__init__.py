"""Rows of table `training` to batches of tensors."""
