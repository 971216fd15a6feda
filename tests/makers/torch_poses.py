"""The exponential of a twist in torch, for tests that turn poses by one."""

import torch

from pipeline.objective.differentiable.poses import exp_so3, pose


def exp_se3(xi):
    """Transform of a twist (rotation vector [rad], translation [m]), differentiable at zero."""
    phi, rho = xi[..., :3], xi[..., 3:]
    t2 = (phi * phi).sum(-1)[..., None, None]
    small = t2 < 1e-4
    safe2 = torch.where(small, torch.ones_like(t2), t2)
    t = safe2.sqrt()
    b = torch.where(small, 0.5 - t2 / 24 + t2 * t2 / 720, 2 * torch.sin(t / 2) ** 2 / safe2)
    c = torch.where(small, 1 / 6 - t2 / 120 + t2 * t2 / 5040, (t - torch.sin(t)) / (safe2 * t))
    x, y, z = phi.unbind(-1)
    o = torch.zeros_like(x)
    W = torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(*phi.shape, 3)
    V = torch.eye(3, dtype=xi.dtype) + b * W + c * (W @ W)
    return pose(exp_so3(phi), (V @ rho[..., None])[..., 0])
