"""Pictures whose borders are known to the pixel, with labels of them: blocks and poles before a wall under the sky."""

import cv2
import numpy as np

from pipeline.perceive.label_gradients import label_gradients

HEIGHT, WIDTH = 160, 320
SKY, BUILDING, CAR, POLE, ROAD = 10, 2, 13, 5, 0
_GREYS = {SKY: 220, BUILDING: 130, CAR: 60, POLE: 40, ROAD: 100}


def picture_and_labels(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A noisy grey picture and labels without an error."""
    rng = np.random.default_rng(seed)
    labels = np.full((HEIGHT, WIDTH), ROAD, np.uint8)
    labels[:100] = BUILDING
    for x in range(0, WIDTH, 40):
        labels[: rng.integers(25, 60), x : x + 40] = SKY
    for x in rng.choice(np.arange(20, WIDTH - 50, 30), 5, replace=False):
        top, left, width = rng.integers(60, 90), x + rng.integers(0, 10), rng.integers(6, 25)
        labels[top : top + 45, left : left + width] = CAR if width > 10 else POLE
    grey = np.vectorize(_GREYS.get)(labels).astype(np.float32) + rng.normal(0, 8, labels.shape)
    return np.clip(cv2.GaussianBlur(grey, (0, 0), 0.8), 0, 255).astype(np.uint8), labels


def moved(
    labels: np.ndarray, right_px: float = 0, down_px: float = 0, wider: float = 0, higher: float = 0
) -> np.ndarray:
    """Labels shifted, and stretched by a share about their middle."""
    height, width = labels.shape
    across, along = 1 + wider, 1 + higher
    M = np.array(
        [
            [across, 0, right_px - wider * (width - 1) / 2],
            [0, along, down_px - higher * (height - 1) / 2],
        ]
    )
    return cv2.warpAffine(
        labels, M, (width, height), flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
    )


def widened(labels: np.ndarray, wide_px: int) -> np.ndarray:
    """Labels whose objects are some pixels too wide on each side, as a coarse network's; not what is behind."""
    things = np.where(np.isin(labels, (CAR, POLE)), labels, 0).astype(np.uint8)
    grown = cv2.dilate(things, np.ones((2 * wide_px + 1, 2 * wide_px + 1), np.uint8))
    return np.where(grown > 0, grown, labels).astype(np.uint8)


def gradients_of(frames: int, wide_px: int = 0, **slip: float) -> np.ndarray:
    """Column `label_gradients` of frames whose labels slipped."""
    found = []
    for seed in range(frames):
        grey, labels = picture_and_labels(seed)
        found.append(label_gradients(grey, moved(widened(labels, wide_px), **slip)))
    return np.stack(found)
