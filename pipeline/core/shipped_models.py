"""The networks in the package, each with a model card, and a check of each file against its card."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

__all__ = ["PREFIX", "REQUIRED", "SHIPPED", "ShippedModel", "shipped_manifest", "shipped_models"]

SHIPPED = Path(__file__).parent.parent / "learn" / "models"
PREFIX = "shipped:"  # in fleet.toml: `model = "shipped:radar_drivable"`

# Keys that the card of a shipped model must have.
REQUIRED = ("purpose", "license", "bytes", "sha256", "command", "data", "limits")


@dataclass(frozen=True)
class ShippedModel:
    """One model file and its card.

    Args:
        file: the .onnx file.
        card: content of the .json file beside it; empty if that is missing or holds no JSON object.
        problems: differences between file and card, in sentences; empty = none.
    """

    file: Path
    card: dict[str, Any]
    problems: tuple[str, ...] = field(default=())

    @property
    def name(self) -> str:
        """Name of the model: its file name without suffix."""
        return self.file.stem


def shipped_manifest(name: str) -> Path:
    """Manifest of the network that fleet.toml names as `shipped:NAME`."""
    return SHIPPED / f"{name.removeprefix(PREFIX)}.toml"


def shipped_models(folder: Path | None = None) -> list[ShippedModel]:
    """Model files under a folder (default: this package), sorted by name, compared with their cards."""
    root = folder or Path(__file__).parent.parent
    return [_compared(file) for file in sorted(root.rglob("*.onnx"), key=lambda f: f.name)]


def _compared(file: Path) -> ShippedModel:
    """Compare one file with its card."""
    try:
        card = json.loads(file.with_suffix(".json").read_text())
    except (OSError, ValueError) as err:
        return ShippedModel(file, {}, (f"no readable card {file.stem}.json: {err}",))
    if not isinstance(card, dict):
        return ShippedModel(file, {}, (f"the card {file.stem}.json holds no JSON object",))
    problems = [f"the card lacks the key {key}" for key in REQUIRED if not card.get(key)]
    if not file.with_suffix(".md").exists():
        problems.append(f"no readable card for users, {file.stem}.md")
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    if card.get("sha256") not in (None, digest):
        problems.append(f"sha256 is {digest}, the card says {card['sha256']}: another file")
    return ShippedModel(file, card, tuple(problems))
