"""The exponential of a twist in torch, for tests that turn poses by one."""

import torch


def exp_se3(xi):
    """Transform of a twist (rotation vector [rad], translation [m]), differentiable at zero."""
    x, y, z, a, b, c = xi.unbind(-1)
    o = torch.zeros_like(x)
    rows = torch.stack([o, -z, y, a, z, o, -x, b, -y, x, o, c, o, o, o, o], -1)
    return torch.linalg.matrix_exp(rows.reshape(*xi.shape[:-1], 4, 4))
