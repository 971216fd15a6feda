"""The losses of `pipeline.objective` once more in torch, differentiable in the poses: what learning minimises."""
