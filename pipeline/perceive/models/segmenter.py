"""Semantic segmentation by ONNX: SegFormer-style logits at reduced resolution, or labels."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.core.errors import ModelOutputError
from pipeline.perceive.labels import LABEL_COUNTS, VOID_ID, to_cityscapes
from pipeline.perceive.models.manifest import Manifest
from pipeline.perceive.models.session import AlikeCheck, Fit, Session, fit_image

__all__ = ["Segmenter", "labels_of_logits"]


class Segmenter:
    """A segmentation model behind its manifest."""

    def __init__(self, manifest: Manifest, providers: Sequence[str] = ()) -> None:
        self._manifest = manifest
        self._session = Session(manifest, (3, *manifest.input.size), providers)
        self.provider = self._session.provider
        self._table = to_cityscapes(manifest.output.label_set)
        self._check_alike = AlikeCheck(manifest.file)

    def segment_each(
        self, images_bgr: Sequence[UInt8[np.ndarray, "H W 3"]], sizes: Sequence[tuple[int, int]]
    ) -> list[UInt8[np.ndarray, "h w"]]:
        """Cityscapes train ids of images at `sizes` (rows, columns), in one run if the model takes batches.

        Raises:
            ModelOutputError: another shape or classes than the manifest's, not finite, or the same for
                several images.
        """
        fitted = [fit_image(image, self._manifest.input) for image in images_bgr]
        outputs = self._session.run_each([tensor for tensor, _ in fitted])
        return [
            self._labels(image, output, fit, size)
            for image, output, (_, fit), size in zip(images_bgr, outputs, fitted, sizes, strict=True)
        ]

    def _labels(
        self, image_bgr: np.ndarray, output: np.ndarray, fit: Fit, size: tuple[int, int]
    ) -> np.ndarray:
        if self._manifest.output.layout == "labels":
            labels = self._plain_labels(output, fit, size)
        else:
            self._check_classes(output)
            labels = labels_of_logits(output[0], fit, self._manifest.input.size, size)
        self._check_alike(image_bgr[::4, ::4], labels)
        return self._table[labels]

    def _check_classes(self, logits: np.ndarray) -> None:
        """Raise if the number of classes is not the label set's."""
        counts = LABEL_COUNTS[self._manifest.output.label_set]
        if logits.ndim != 4 or logits.shape[0] != 1 or logits.shape[1] not in counts:
            wanted = " or ".join(map(str, counts))
            raise ModelOutputError(
                str(self._manifest.file),
                f"output.layout: logits of {self._manifest.output.label_set} must be 1 x {wanted} x h x w, "
                f"the model gives {list(logits.shape)}",
            )

    def _plain_labels(self, output: np.ndarray, fit: Fit, size: tuple[int, int]) -> np.ndarray:
        is_plane = output.ndim >= 2 and output.size == output.shape[-2] * output.shape[-1]
        most = max(LABEL_COUNTS[self._manifest.output.label_set])
        if not is_plane or output.min() < 0 or np.any((output >= most) & (output != VOID_ID)):
            raise ModelOutputError(
                str(self._manifest.file),
                f"output.layout: labels of {self._manifest.output.label_set} must be one image of 0..{most - 1} or "
                f"{VOID_ID}, the model gives {list(output.shape)}, {output.min():g} to {output.max():g}",
            )
        plane = output.reshape(output.shape[-2:]).astype(np.float32)
        labels = _resample(plane, fit, self._manifest.input.size, size, cv2.INTER_NEAREST)
        return labels.astype(np.uint8)


def labels_of_logits(
    logits: Float[np.ndarray, "C h w"], fit: Fit, input_size: tuple[int, int], size: tuple[int, int]
) -> UInt8[np.ndarray, "H W"]:
    """Most likely class at each label pixel.

    Logits are interpolated bilinearly before the choice, so that boundaries are not steps of the output's
    stride; pixel centres stay aligned, and the padding of a letterbox is left out.
    """
    best = np.full(size, -np.inf, np.float32)
    label = np.zeros(size, np.uint8)
    for c, plane in enumerate(logits):
        value = _resample(np.asarray(plane, np.float32), fit, input_size, size, cv2.INTER_LINEAR)
        better = value > best
        best[better] = value[better]
        label[better] = c
    return label


def _resample(
    plane: np.ndarray, fit: Fit, input_size: tuple[int, int], size: tuple[int, int], interpolation: int
) -> np.ndarray:
    """A plane over the model's whole input, sampled at the centres of label pixels."""
    stride_y, stride_x = input_size[0] / plane.shape[0], input_size[1] / plane.shape[1]
    # Centre of label pixel i: (i + 0.5) label pixels from the edge of the image -> input pixels -> output
    # pixels.
    step_x, step_y = fit.width / size[1] / stride_x, fit.height / size[0] / stride_y
    M = np.array(
        [
            [step_x, 0.0, 0.5 * step_x + fit.offset_x / stride_x - 0.5],
            [0.0, step_y, 0.5 * step_y + fit.offset_y / stride_y - 0.5],
        ]
    )
    return cv2.warpAffine(
        plane,
        M,
        (size[1], size[0]),
        flags=interpolation | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
