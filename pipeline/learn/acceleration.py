"""Lower precision and compilation, for the encoders only: geometry in sixteen bits would be wrong by metres."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from pipeline.learn.encoders import CameraEncoder, LidarEncoder
from pipeline.learn.networks import CalibrationNetwork

__all__ = ["accelerate"]


def accelerate(network: CalibrationNetwork, *, half: bool, compiled: bool) -> None:
    """Run the network's image encoders in bfloat16, compiled, or both; parameters and outputs stay float32.

    Args:
        network: changed in place.
        half: bfloat16 where the device has it in hardware.
        compiled: by torch.compile.
    """
    for module in network.modules():
        if isinstance(module, CameraEncoder | LidarEncoder):
            if compiled:
                module.compile()
            if half:
                _in_bfloat16(module)


def _in_bfloat16(module: nn.Module) -> None:
    contexts: list[Any] = []

    def enter(_module: nn.Module, _inputs: Any) -> None:
        contexts.append(torch.autocast("cuda", torch.bfloat16))
        contexts[-1].__enter__()

    def leave(_module: nn.Module, _inputs: Any, output: Any) -> Any:
        contexts.pop().__exit__(None, None, None)
        return output.float() if isinstance(output, torch.Tensor) else output

    module.register_forward_pre_hook(enter)
    module.register_forward_hook(leave)
