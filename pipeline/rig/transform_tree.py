"""Static transforms as logged: a tree of frames with lookups in both directions."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.rig.se3 import from_quaternion, inverse

__all__ = ["TransformTree"]

_SAME = 1e-9  # tolerance for two copies of one transform
_UNIT_TOLERANCE = 0.01  # quaternions farther from unit length are rejected as damaged


class TransformTree:
    """Edges `T_parent_child` by frame ids; the last one logged for a child is valid."""

    def __init__(self) -> None:
        self._parent_of: dict[str, tuple[str, np.ndarray]] = {}
        self.twice: set[str] = set()  # children logged more than once, with different transforms

    @property
    def edges(self) -> dict[str, str]:
        """Parent of each child frame."""
        return {child: parent for child, (parent, _) in self._parent_of.items()}

    def add_message(self, message: Any) -> int:
        """Add the transforms of a tf2_msgs/TFMessage; returns the number of non-rigid entries."""
        bad = 0
        for entry in message.transforms:
            q, t = entry.transform.rotation, entry.transform.translation
            rotation, translation = (q.w, q.x, q.y, q.z), (t.x, t.y, t.z)
            bad += not self.add(entry.header.frame_id, entry.child_frame_id, rotation, translation)
        return bad

    def add(
        self,
        parent: str,
        child: str,
        q_wxyz: tuple[float, float, float, float],
        t: tuple[float, float, float],
    ) -> bool:
        """Add an edge; returns False and adds nothing if it is not a rigid transform between two frames."""
        parent, child = parent.lstrip("/"), child.lstrip("/")
        numbers = np.array([*q_wxyz, *t], np.float64)
        is_rigid = np.all(np.isfinite(numbers)) and abs(np.linalg.norm(numbers[:4]) - 1) < _UNIT_TOLERANCE
        if not is_rigid or not parent or not child or parent == child:
            return False
        self.add_transform(parent, child, from_quaternion(numbers[:4], numbers[4:]))
        return True

    def add_transform(self, parent: str, child: str, T_parent_child: Float[np.ndarray, "4 4"]) -> None:
        """Add an edge that is known to be a rigid transform between two frames."""
        known = self._parent_of.get(child)
        if known is not None and (known[0] != parent or np.abs(known[1] - T_parent_child).max() > _SAME):
            self.twice.add(child)
        self._parent_of[child] = (parent, T_parent_child)

    def fill_from(self, other: TransformTree) -> None:
        """Copy edges of frames that this tree lacks: a split recording logs them in its first file only."""
        for child, edge in other._parent_of.items():
            self._parent_of.setdefault(child, edge)

    def lookup(self, a: str, b: str) -> Float[np.ndarray, "4 4"] | None:
        """T_a_b along the shortest chain of edges; None if no chain joins the two frames."""
        a, b = a.lstrip("/"), b.lstrip("/")
        neighbours: dict[str, list[tuple[str, np.ndarray]]] = {}
        for child, (parent, T_parent_child) in self._parent_of.items():
            neighbours.setdefault(parent, []).append((child, T_parent_child))
            neighbours.setdefault(child, []).append((parent, inverse(T_parent_child)))
        if not a or a not in neighbours:
            return None
        reached = {a: np.eye(4)}
        queue = deque([a])
        while queue:
            frame = queue.popleft()
            if frame == b:
                return reached[b]
            for following, T_frame_following in neighbours[frame]:
                if following not in reached:
                    reached[following] = reached[frame] @ T_frame_following
                    queue.append(following)
        return None
