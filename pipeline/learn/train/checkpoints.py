"""A run's state on disk: written aside and renamed, so that a kill at any moment leaves a whole one."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch

from pipeline.core.errors import ContractError

__all__ = ["BEST", "LAST", "load_checkpoint", "save_checkpoint"]

LAST, BEST = "last.pt", "best.pt"
_FORMAT = 1


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write atomically; `state` holds tensors, numbers, strings, lists and dicts only."""
    aside = path.with_suffix(".part")
    with aside.open("wb") as stream:
        torch.save({"format": _FORMAT} | state, stream)
        stream.flush()
        os.fsync(stream.fileno())
    aside.replace(path)


def load_checkpoint(path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a checkpoint without running code in it; raises ContractError if it has another format."""
    try:
        state: dict[str, Any] = torch.load(path, map_location=device, weights_only=True)
    except FileNotFoundError:
        raise
    except Exception as err:  # torch raises whatever its unpickler met
        raise ContractError(str(path), f"no checkpoint that can be read: {err}") from err
    if state.get("format") != _FORMAT:
        raise ContractError(str(path), f"checkpoint of format {state.get('format')}, not {_FORMAT}")
    return state
