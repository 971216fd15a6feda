"""Lower precision and compilation, for the encoders only: geometry in sixteen bits would be wrong by metres."""

from __future__ import annotations

import torch
from torch import nn

from pipeline.learn.network.encoders import CameraEncoder, LidarEncoder

__all__ = ["accelerate"]


def accelerate(network: nn.Module, *, half: bool, compiled: bool) -> None:
    """Set the image encoders to bfloat16, compile them, or both; parameters and outputs stay float32."""
    for module in network.modules():
        if isinstance(module, CameraEncoder | LidarEncoder):
            if half:
                _in_bfloat16(module)
            if compiled:
                module.compile()


def _in_bfloat16(module: nn.Module) -> None:
    forward = module.forward

    def in_bfloat16(inputs: torch.Tensor) -> torch.Tensor:
        with torch.autocast(inputs.device.type, torch.bfloat16):
            output: torch.Tensor = forward(inputs)
        return output.float()

    # In place of hooks, which a compiler would have to stop at.
    module.forward = in_bfloat16
