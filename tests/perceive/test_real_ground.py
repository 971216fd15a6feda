"""On real sweeps the lidar stands at one height over the road: in car parks, between ditches, beside snow banks."""

from itertools import islice

import numpy as np
import pytest

from pipeline.perceive.ground import find_ground

pytestmark = [pytest.mark.real_logs]


def sweeps(log):
    """Points of every second sweep of one log; a car park and a road between ditches are among them."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with log.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, _, _, cloud in islice(reader.iter_decoded_messages(["/lidar/top/points"]), 1, None, 2):
            raw = np.frombuffer(bytes(cloud.data), np.uint8).reshape(-1, cloud.point_step)
            yield raw[:, :12].copy().view("<f4")  # x y z come first, float32


def test_the_lidars_height_over_the_road_is_the_same_in_every_sweep(real_logs):
    heights, tilts = [], []
    for log in ("astyx-1_2019-01-14_00.mcap", "astyx-1_2019-01-14_01.mcap"):
        for points in sweeps(real_logs / log):
            planes = np.array([find_ground(points, 0.15, np.random.default_rng(s)).plane for s in range(2)])
            assert np.ptp(planes[:, 3]) < 0.05
            heights.append(planes[0, 3])
            tilts.append(np.degrees(np.arccos(planes[0, 2])))
    assert len(heights) == 46
    # The road's own crown and slope, and the vehicle's load, are in this spread; measured 1.63 .. 1.82 m.
    assert np.max(np.abs(np.array(heights) - np.median(heights))) < 0.15
    assert np.max(tilts) < 4.5
