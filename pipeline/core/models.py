"""Models that are shipped, with their cards, and third-party models that `boresight models --fetch` downloads."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from pipeline.core.errors import ConfigError

__all__ = [
    "CATALOGUE", "PREFIX", "REQUIRED", "SHIPPED", "ThirdPartyModel", "manifest_text", "named",
    "semantics_line", "shipped_manifest", "shipped_models",
]  # fmt: skip

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


@dataclass(frozen=True)
class ThirdPartyModel:
    """One ONNX file at a pinned address.

    Args:
        name: of file and manifest, without suffix.
        task: what fleet.toml uses it for.
        url: pinned by revision or release.
        size_bytes: of the file.
        sha256: of the file.
        licence: its name, and what it forbids.
        licence_url: its text.
        interface: sections `[input]` and `[output]` of the manifest.
        tried: which parts of this entry were tested.
    """

    name: str
    task: Literal["segment", "detect"]
    url: str
    size_bytes: int
    sha256: str
    licence: str
    licence_url: str
    interface: str
    tried: str


# Sizes and hashes agree in at least three public repositories each that pin the same address.
CATALOGUE: Final = (
    ThirdPartyModel(
        name="segformer-b0-ade20k",
        task="segment",
        url="https://huggingface.co/Xenova/segformer-b0-finetuned-ade-512-512/resolve/"
        "d3e5499fa8701ff0453ca940a8dfeae39b2f1504/onnx/model.onnx",
        size_bytes=15_335_446,
        sha256="3e5c18a4be395f16646438d54c42377ddc202edfa33d5eced0c9506de75c44c2",
        licence="NVIDIA Source Code License for SegFormer: research and evaluation only, no commercial use",
        licence_url="https://github.com/NVlabs/SegFormer/blob/master/LICENSE",
        interface="""[input]
size = [512, 1024]
colour = "rgb"
scale = 0.00392156862745098
mean = [0.485, 0.456, 0.406]
std = [0.229, 0.224, 0.225]
fit = "letterbox_centre"

[output]
layout = "logits"
label_set = "ade20k"
""",
        tried="neither the download nor the model; the interface is that of its published preprocessor",
    ),
    ThirdPartyModel(
        name="yolox-nano",
        task="detect",
        url="https://github.com/Megvii-BaseDetection/YOLOX/releases/download/0.1.1rc0/yolox_nano.onnx",
        size_bytes=3_659_407,
        sha256="c789161ed43c8269fcd4e67c67eeeb4e80c622da2eb296a20bc6007bd18a0b7d",
        licence="Apache-2.0",
        licence_url="https://github.com/Megvii-BaseDetection/YOLOX/blob/main/LICENSE",
        interface="""[input]
size = [416, 416]
colour = "bgr"
fit = "letterbox_top_left"
tile_scales = [0.625, 0.25]     # also on tiles, for road users that are small in the image; costs a run a tile

[output]
layout = "yolox"
label_set = "coco"
""",
        tried="the manifest, on another export of the same network; not the download",
    ),
)


def named(names: Sequence[str]) -> list[ThirdPartyModel]:
    """Models of the catalogue by name; all models if no name is given.

    Raises:
        ConfigError: no such model.
    """
    known = {model.name: model for model in CATALOGUE}
    for name in names:
        if name not in known:
            raise ConfigError("command line", "NAME", f"no model {name!r}; there are {', '.join(known)}")
    return [known[name] for name in dict.fromkeys(names or known)]


def manifest_text(model: ThirdPartyModel) -> str:
    """Text of the manifest of a downloaded model."""
    return (
        f"# From {model.url}\n# Licence: {model.licence} ({model.licence_url})\n"
        f'path = "{model.name}.onnx"\nsha256 = "{model.sha256}"\ntask = "{model.task}"\n\n{model.interface}'
    )


def semantics_line(folder: str) -> str:
    """Line of fleet.toml that selects the catalogue's models in a folder (relative to fleet.toml)."""
    by_task = {model.task: f"{folder}/{model.name}.toml" for model in CATALOGUE}
    segmenter, detector = by_task["segment"], by_task["detect"]
    return f'semantics = {{ source = "onnx", segmenter = "{segmenter}", detector = "{detector}" }}'


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
        problems.append(f"sha256 is {digest}; its card states {card['sha256']}: another file")
    return ShippedModel(file, card, tuple(problems))
