"""ONNX Runtime sessions and how images get into them and pixels back out."""

from __future__ import annotations

import os
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import onnxruntime as ort
from jaxtyping import Float32, UInt8

from pipeline.core.errors import ModelError, ModelOutputError
from pipeline.core.memory import MODEL_THREADS, usable_cpus
from pipeline.perceive.models.manifest import InputSpec, ModelFile

__all__ = ["AlikeCheck", "Fit", "Session", "fit_image"]

_CUDA, _CPU = "CUDAExecutionProvider", "CPUExecutionProvider"
_MOST_ALIKE = 3  # successive answers that are the same to the last bit though the inputs differ


@dataclass(frozen=True)
class Fit:
    """Placement of an image in a model's input: `input = pixel * scale + offset` for pixel edges (x, y)."""

    scale_x: float
    scale_y: float
    offset_x: int
    offset_y: int
    width: int
    height: int


class AlikeCheck:
    """Refuses a model with equal outputs for several different inputs, because it does not use its input."""

    def __init__(self, manifest_file: object) -> None:
        self._file = str(manifest_file)
        self._shown, self._before, self._alike = 0, np.zeros(0), 0

    def __call__(self, shown: np.ndarray, answer: np.ndarray) -> None:
        """Take the next input and output; raises ModelOutputError if several inputs had the same output."""
        own = zlib.crc32(shown.tobytes())
        if own != self._shown:
            self._alike = self._alike + 1 if np.array_equal(answer, self._before) else 0
            self._shown, self._before = own, answer
        if self._alike >= _MOST_ALIKE:
            told = f"the model gives the same answer for {_MOST_ALIKE + 1} different inputs in a row"
            raise ModelOutputError(self._file, told)


class Session:
    """One model on the first available of ONNX Runtime's providers; () = CUDA if available, else the CPU.

    Args:
        shape: of one input, without the axis of the batch: channels, rows, columns.
    """

    def __init__(
        self, manifest: ModelFile, shape: tuple[int, int, int], providers: Sequence[str] = ()
    ) -> None:
        self._file = str(manifest.file)
        self._session = _open(manifest, providers)
        self._input, self._takes_batches = self._checked_input(shape)
        self._check_alike = AlikeCheck(manifest.file)
        self.provider = str(self._session.get_providers()[0])

    def run(self, tensor: Float32[np.ndarray, "1 C H W"]) -> np.ndarray:
        """First output of the model.

        Raises:
            ModelError: the model does not run on this input.
            ModelOutputError: the output is not finite, or the same for several inputs.
        """
        return self._checked(tensor, self._first_output(tensor))

    def run_each(self, tensors: Sequence[Float32[np.ndarray, "1 C H W"]]) -> list[np.ndarray]:
        """First output for each of several inputs, in one run if the batch axis is free.

        Raises:
            ModelError: as `run`, or only the input has a batch axis.
            ModelOutputError: as `run`.
        """
        if len(tensors) < 2 or not self._takes_batches:
            return [self.run(tensor) for tensor in tensors]
        output = self._first_output(np.concatenate(tensors))
        if output.shape[:1] != (len(tensors),):
            told = f"{len(tensors)} images give {list(output.shape)}: set perceive.batch = 1"
            raise ModelError(self._file, f"the input has a batch axis, the output has none: {told}")
        return [self._checked(tensor, output[i : i + 1]) for i, tensor in enumerate(tensors)]

    def _first_output(self, tensor: np.ndarray) -> np.ndarray:
        try:
            output: np.ndarray = self._session.run(None, {self._input: tensor})[0]
        except Exception as err:  # onnxruntime's own exceptions share no base but this
            raise ModelError(self._file, f"the model failed to run: {err}") from err
        return output

    def _checked(self, tensor: np.ndarray, output: np.ndarray) -> np.ndarray:
        if np.isnan(output).any() or np.isposinf(output).any():
            raise ModelOutputError(self._file, "the model gives NaN or infinity")
        self._check_alike(tensor[..., ::4, ::4], output)
        return output

    def _checked_input(self, shape: tuple[int, int, int]) -> tuple[str, bool]:
        """Name of the input, and whether the axis of its batch is free."""
        inputs = self._session.get_inputs()
        if len(inputs) != 1 or inputs[0].type != "tensor(float)":
            found = ", ".join(f"{i.name} {i.type}" for i in inputs)
            raise ModelError(self._file, f"path: the model must take one float32 image, it takes {found}")
        wanted, taken = (1, *shape), inputs[0].shape
        fits = len(taken) == len(wanted) and all(
            not isinstance(s, int) or s == w for s, w in zip(taken, wanted, strict=True)
        )
        if not fits:
            told = (
                f"{list(shape[1:])} does not go with the model's input {taken} (1, {shape[0]}, rows, columns)"
            )
            raise ModelError(self._file, f"input.size: {told}")
        return str(inputs[0].name), not isinstance(taken[0], int)


def _open(manifest: ModelFile, providers: Sequence[str]) -> ort.InferenceSession:
    """A session on the first available provider; raises ModelError if there is none, or no model."""
    file, options = str(manifest.file), ort.SessionOptions()
    # Threads on the CPU: the share of a worker of the night, else all that the process may use.
    share = os.environ.get(MODEL_THREADS) or os.environ.get("OMP_NUM_THREADS") or ""
    options.inter_op_num_threads = 1
    options.intra_op_num_threads = max(1, int(share)) if share.isdigit() else usable_cpus()
    # Workers run side by side, and a spinning pool would steal their cores.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    options.log_severity_level = 3  # its warnings are about graph optimisation, not about results
    chosen = _chosen_providers(providers, file)
    try:
        session = ort.InferenceSession(str(manifest.model_file), options, providers=chosen)
    except Exception as err:  # onnxruntime's own exceptions share no base but this
        raise ModelError(file, f"path: onnxruntime cannot load the model: {err}") from err
    # Where a provider's libraries do not load, onnxruntime falls back to the CPU by itself.
    if providers and session.get_providers()[0] not in providers:
        told = f"onnxruntime could not start {' or '.join(chosen)}: are its driver and libraries installed?"
        raise ModelError(file, f"perceive.providers: {told}")
    return session


def _chosen_providers(wanted: Sequence[str], manifest_file: str) -> list[str]:
    """Of the wanted providers those that this onnxruntime has."""
    available = ort.get_available_providers()
    if not wanted:
        return [p for p in (_CUDA, _CPU) if p in available]
    chosen = [p for p in wanted if p in available]
    if not chosen:
        told = f"this onnxruntime has {', '.join(available)}, not {', '.join(wanted)}"
        cuda = ". CUDA comes with pip install 'boresight[gpu]'" if _CUDA in wanted else ""
        raise ModelError(manifest_file, f"perceive.providers: {told}{cuda}; add {_CPU} to fall back to it")
    return chosen


def fit_image(
    image_bgr: UInt8[np.ndarray, "H W 3"], spec: InputSpec
) -> tuple[Float32[np.ndarray, "1 3 h w"], Fit]:
    """The model's input for an image, and the image's placement."""
    rows, columns = spec.size
    height, width = image_bgr.shape[:2]
    scale_x, scale_y = columns / width, rows / height
    if spec.fit != "stretch":
        scale_x = scale_y = min(scale_x, scale_y)
    inner = (max(1, round(width * scale_x)), max(1, round(height * scale_y)))
    resized = cv2.resize(image_bgr, inner, interpolation=cv2.INTER_LINEAR)
    left, top = (columns - inner[0]) // 2, (rows - inner[1]) // 2
    if spec.fit == "letterbox_top_left":
        left, top = 0, 0
    canvas = np.full((rows, columns, 3), spec.pad, np.float32)
    canvas[top : top + inner[1], left : left + inner[0]] = resized
    if spec.colour == "rgb":
        canvas = canvas[..., ::-1]
    mean, std = (np.array(v, np.float32) for v in (spec.mean, spec.std))
    normal = (canvas * np.float32(spec.scale) - mean) / std
    tensor = np.ascontiguousarray(normal.transpose(2, 0, 1)[None], np.float32)
    # The true ratio after rounding to whole pixels, not the wanted one.
    return tensor, Fit(inner[0] / width, inner[1] / height, left, top, inner[0], inner[1])
