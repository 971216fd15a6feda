"""The losses of `pipeline.objective` in torch, differentiable in the poses, for training."""
