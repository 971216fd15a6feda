"""The networks that ship inside the package, each with its card, and whether files are what their cards speak of."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

__all__ = ["PREFIX", "REQUIRED", "SHIPPED", "ShippedModel", "shipped_manifest", "shipped_models"]

SHIPPED = Path(__file__).parent / "learn" / "models"
PREFIX = "shipped:"  # in fleet.toml: `model = "shipped:radar_drivable"`

# What a card must say before its model ships.
REQUIRED = ("purpose", "license", "bytes", "sha256", "command", "data", "limits")


@dataclass(frozen=True)
class ShippedModel:
    """One model file as its card describes it.

    Args:
        file: the .onnx file.
        card: what the .json beside it says; empty where it is missing or no JSON object.
        problems: what does not hold, in sentences; empty = the file is the one that the card speaks of.
    """

    file: Path
    card: dict[str, Any]
    problems: tuple[str, ...] = field(default=())

    @property
    def name(self) -> str:
        """What the model is called: its file without suffix."""
        return self.file.stem


def shipped_manifest(name: str) -> Path:
    """The manifest that fleet.toml names by `shipped:NAME`."""
    return SHIPPED / f"{name.removeprefix(PREFIX)}.toml"


def shipped_models(folder: Path | None = None) -> list[ShippedModel]:
    """Every model file under a folder (default: this package), by name, compared with its card."""
    root = folder or Path(__file__).parent
    return [_compared(file) for file in sorted(root.rglob("*.onnx"), key=lambda f: f.name)]


def _compared(file: Path) -> ShippedModel:
    """Card and problems of one file."""
    try:
        card = json.loads(file.with_suffix(".json").read_text())
    except (OSError, ValueError) as err:
        return ShippedModel(file, {}, (f"no readable card {file.stem}.json: {err}",))
    if not isinstance(card, dict):
        return ShippedModel(file, {}, (f"the card {file.stem}.json holds no JSON object",))
    problems = [f"the card does not say: {key}" for key in REQUIRED if not card.get(key)]
    if not file.with_suffix(".md").exists():
        problems.append(f"no card for people, {file.stem}.md")
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    if card.get("sha256") not in (None, digest):
        problems.append(f"sha256 is {digest}, the card says {card['sha256']}: another file")
    return ShippedModel(file, card, tuple(problems))
