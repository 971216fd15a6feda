"""Static transforms found along a tree with known answers."""

from types import SimpleNamespace as Space

import numpy as np
import pytest

from pipeline.rig.se3 import exp_se3, inverse, to_quaternion
from pipeline.rig.transform_tree import TransformTree


def test_transforms_are_found_along_the_tree_in_both_directions():
    rng = np.random.default_rng(1)
    names = ["map", "base", "kit", "camera", "lidar", "radar", "alone", "island"]
    parents = {
        "base": "map",
        "kit": "base",
        "camera": "kit",
        "lidar": "kit",
        "radar": "base",
        "island": "alone",
    }
    T_map = {"map": np.eye(4), "alone": np.eye(4)}
    tree = TransformTree()
    for child, parent in parents.items():
        T = exp_se3(rng.normal(size=6))
        T_map[child] = T_map[parent] @ T
        assert tree.add(f"/{parent}", child, tuple(to_quaternion(T)), tuple(T[:3, 3]))
    for a in names[:6]:
        for b in names[:6]:
            np.testing.assert_allclose(tree.lookup(a, b), inverse(T_map[a]) @ T_map[b], atol=1e-12)
    assert tree.lookup("camera", "island") is None
    assert tree.lookup("camera", "nowhere") is None
    assert tree.lookup("", "camera") is None


@pytest.mark.parametrize(
    "q", [(0.0, 0.0, 0.0, 0.0), (np.nan, 0.0, 0.0, 1.0), (2.0, 0.0, 0.0, 0.0), (0.5, 0.0, 0.0, 0.0)]
)
def test_what_is_no_rotation_is_not_taken(q):
    tree = TransformTree()
    assert not tree.add("a", "b", q, (0.0, 0.0, 0.0))
    assert tree.lookup("a", "b") is None
    entry = Space(
        header=Space(frame_id="a"),
        child_frame_id="b",
        transform=Space(
            rotation=Space(w=q[0], x=q[1], y=q[2], z=q[3]), translation=Space(x=0.0, y=0.0, z=0.0)
        ),
    )
    assert tree.add_message(Space(transforms=[entry])) == 1
