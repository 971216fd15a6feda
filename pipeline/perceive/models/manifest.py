"""Model manifests: a small TOML file next to each ONNX file describes its input, output and hash.

Examples for a detector and a segmenter: `pipeline/perceive/README.md`.
"""

from __future__ import annotations

import hashlib
import tomllib
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PositiveFloat,
    PositiveInt,
    ValidationError,
    model_validator,
)

from pipeline.core.errors import ModelError
from pipeline.perceive.labels import DETECTOR_SETS, LABEL_SETS

__all__ = ["InputSpec", "Manifest", "ModelFile", "OutputSpec", "Section", "load_manifest", "read_manifest"]

_Unit = Annotated[float, Field(ge=0, le=1)]


class Section(BaseModel):
    """A section of a manifest: unknown keys, nan and inf are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ModelFile(Section):
    """Common entries of all manifests: the model file."""

    path: str
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    file: Path = Path()  # of the manifest itself, set on reading

    @property
    def model_file(self) -> Path:
        """The ONNX file."""
        return self.file.parent / self.path


_Kind = TypeVar("_Kind", bound=ModelFile)


class InputSpec(Section):
    """How an image becomes the model's input, float32 1x3xHxW."""

    size: tuple[PositiveInt, PositiveInt]
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[PositiveFloat, PositiveFloat, PositiveFloat] = (1.0, 1.0, 1.0)
    scale: PositiveFloat = 1.0
    colour: Literal["rgb", "bgr"] = "rgb"
    fit: Literal["letterbox_top_left", "letterbox_centre", "stretch"] = "letterbox_centre"
    pad: float = 114.0
    tile_scales: tuple[Annotated[float, Field(gt=0, le=1)], ...] = ()
    tile_overlap: Annotated[float, Field(ge=0, lt=1)] = 0.35


class OutputSpec(Section):
    """Output of a model."""

    layout: Literal["yolox", "yolov5", "yolov8", "logits", "labels"]
    label_set: str
    strides: tuple[PositiveInt, ...] = (8, 16, 32)
    nms_iou: _Unit = 0.5
    min_score: _Unit = 0.05  # candidates for non-maximum suppression; the config's threshold comes after


class Manifest(ModelFile):
    """One model for images."""

    task: Literal["detect", "segment"]
    input: InputSpec
    output: OutputSpec

    @model_validator(mode="after")
    def _output_goes_with_task(self) -> Manifest:
        segments = self.output.layout in ("logits", "labels")
        if segments != (self.task == "segment"):
            raise ValueError(f'output.layout = "{self.output.layout}" does not go with task = "{self.task}"')
        known = LABEL_SETS if segments else DETECTOR_SETS
        if self.output.label_set not in known:
            raise ValueError(f'output.label_set = "{self.output.label_set}" is not one of {", ".join(known)}')
        if segments and self.input.tile_scales:
            raise ValueError("input.tile_scales is for detectors only")
        return self


def load_manifest(file: Path, task: Literal["detect", "segment"]) -> Manifest:
    """Read and check a manifest and the hash of its model.

    Raises:
        ModelError: missing file, unknown key, impossible value, wrong task or hash; names the manifest and
            the key.
    """
    manifest = read_manifest(file, Manifest)
    if manifest.task != task:
        raise ModelError(str(file), f'task: is "{manifest.task}", but fleet.toml uses it to {task}')
    return manifest


def read_manifest(file: Path, kind: type[_Kind]) -> _Kind:
    """A manifest of this kind; its field `file` becomes the path that it was read from.

    Raises:
        ModelError: missing file, unknown key, impossible value, or a model with another hash.
    """
    try:
        raw = tomllib.loads(file.read_text())
        manifest = kind.model_validate({k: v for k, v in raw.items() if k != "file"} | {"file": file})
    except FileNotFoundError as err:
        raise ModelError(str(file), "no such manifest") from err
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, IsADirectoryError) as err:
        raise ModelError(str(file), f"not a TOML file: {err}") from err
    except ValidationError as err:
        problems = err.errors(include_url=False)
        text = "; ".join(f"{'.'.join(map(str, p['loc'])) or 'manifest'}: {p['msg']}" for p in problems)
        raise ModelError(str(file), text) from err
    model = manifest.model_file
    try:
        with model.open("rb") as stream:
            found = hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as err:
        raise ModelError(str(file), f"path: cannot read {model}: {err.strerror}") from err
    if found != manifest.sha256:
        raise ModelError(str(file), f"sha256: {model} has {found}, not {manifest.sha256}")
    return manifest
