"""Interface of a network to a vehicle-day: from one frame and a guess to transforms with variances."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from pipeline.learn.infer.class_evidence import FrameEvidence
from pipeline.rig.estimates import Prior
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
        """True if camera_radar is the product of the other two pairs before its correction."""
        ...

    @property
    def bias_sigma(self) -> Mapping[str, np.ndarray]:
        """By pair, sigma of the bias that all answers share (see `aggregate`); a pair is missing where unknown."""
        ...

    def sensors(self, frame: Frame, observation: Observation, prior: Prior) -> Any:
        """Inputs of `answer` from a frame; raises SampleRejectedError if it shows too little."""
        ...

    def evidence(self, sensors: Any, T_camera_lidar: np.ndarray) -> FrameEvidence | None:
        """Matching evidence of camera and lidar, points chosen at a guess; None if the network returns none."""
        ...

    def answer(self, sensors: Any, guess: Mapping[str, np.ndarray]) -> FrameAnswer:
        """Transforms from one frame, started at a guess for every pair."""
        ...
