"""What a vehicle-day asks of a network: one frame and a guess in, transforms with their variances out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from pipeline.extrinsics.estimates import Prior
from pipeline.learn.infer.class_evidence import FrameEvidence
from schemas.frames import Frame
from schemas.observations import Observation

__all__ = ["FrameAnswer", "FrameNetwork", "FrameSource"]

# frames(indices) yields the frames of a day with these frame_index, in order.
FrameSource = Callable[[Sequence[int]], Iterator[Frame]]


@dataclass(frozen=True, eq=False)
class FrameAnswer:
    """A network's answer to one frame and guess, for the pairs that it estimates."""

    T: Mapping[str, np.ndarray]
    variance: Mapping[str, np.ndarray]  # of a twist on the left [rad^2, m^2]


@runtime_checkable
class FrameNetwork(Protocol):
    """A network as a vehicle-day uses it."""

    @property
    def pairs(self) -> tuple[str, ...]:
        """Pairs that it estimates."""
        ...

    @property
    def composed(self) -> bool:
        """True where it composes camera_radar of the other two pairs before it corrects it."""
        ...

    @property
    def bias_sigma(self) -> Mapping[str, np.ndarray]:
        """By pair, sigma of the bias that all answers share (see `aggregate`); a pair is missing where unknown."""
        ...

    def sensors(self, frame: Frame, observation: Observation, prior: Prior) -> Any:
        """What `answer` needs of a frame; raises SampleRejectedError where the frame shows too little."""
        ...

    def evidence(self, sensors: Any, T_camera_lidar: np.ndarray) -> FrameEvidence | None:
        """What camera and lidar are matched by, points chosen through a guess; None where the network does not say."""
        ...

    def answer(self, sensors: Any, guess: Mapping[str, np.ndarray]) -> FrameAnswer:
        """Transforms from one frame, started at a guess for every pair."""
        ...
