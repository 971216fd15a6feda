"""Random damage to real small logs: nothing but BoresightError ever comes out, and no frame that was not put in."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.core.errors import BoresightError
from schemas.calibrations import SENSORS
from tests.ingest.containers.test_containers import write

CONTAINERS = {"mcap": "mcap_plain", "bag": "bag_lz4", "db3": "db3_file"}
TRIALS = 20  # per container and kind of damage: 20 x 3 x 3 logs


def damaged(data, kind, rng):
    data = bytearray(data)
    if kind == "cut":
        return data[: rng.integers(0, len(data))]
    if kind == "torn":  # a stretch overwritten, lost or repeated, as a bad disk or a careless copy leaves it
        start, length = int(rng.integers(0, len(data))), int(rng.integers(1, 5000))
        noise = rng.integers(0, 256, length, np.uint8).tobytes()
        stretch = data[start : start + length]
        data[start : start + length] = [noise[: len(stretch)], b"", stretch * 2][rng.integers(0, 3)]
        return data
    # Half of the flips fall into the last tenth, where indices and summaries are.
    for _ in range(rng.integers(1, 4)):
        low = int(0.9 * len(data)) if rng.random() < 0.5 else 0
        data[rng.integers(low, len(data))] ^= 1 << rng.integers(0, 8)
    return data


@pytest.mark.parametrize("container", CONTAINERS)
@pytest.mark.parametrize("kind", ["cut", "flipped", "torn"])
def test_damaged_logs_give_only_whole_frames_or_a_plain_refusal(kit, tmp_path, run_ingest, container, kind):
    good = write(kit, tmp_path, CONTAINERS[container], frames=6)
    data = good.read_bytes()
    truth = {f.stamp_ns: f for f in run_ingest(good, name="good")[1]}
    assert len(truth) == 6
    by_radar = {f.radar_stamp_ns: stamp for stamp, f in truth.items()}
    rng = np.random.default_rng([len(container), len(kind)])
    survived = 0
    for trial in range(TRIALS):
        bad = tmp_path / f"bad{good.suffix}"
        bad.write_bytes(damaged(data, kind, rng))
        frames = []
        try:
            result, frames = run_ingest(bad, name=f"lake{trial}")
        except BoresightError as err:
            refused = str(err)
        else:
            refused = "" if result.status == "done" else result.reason
            survived += len(frames)
            # Bags and SQLite files carry no checksums: a flip inside a float cannot be seen, a cut can.
            for frame in frames if kind == "cut" or container == "mcap" else []:
                # Without a sweep left, the moment's stamp is the scan's.
                at = frame.stamp_ns if "lidar" in frame.sensors else by_radar[frame.radar_stamp_ns]
                assert_same(frame, truth[at])
        assert frames or refused
    # Salvage, not mere refusal: half a file holds some two of six frames, less a torn chunk.
    assert survived > TRIALS * 6 * (0.5 if kind == "flipped" else 0.2)


def assert_same(frame, expected):
    for sensor in set(SENSORS) - set(frame.sensors):
        # What of it was lost is empty; the others are whole.
        names = [n for n in frame.__dict__ if n.startswith(f"{sensor}_")]
        names += ["image", "labels_png"] if sensor == "camera" else []
        frame = replace(frame, **{n: getattr(expected, n) for n in names})
    assert (frame.camera_stamp_ns, frame.radar_stamp_ns) == (
        expected.camera_stamp_ns,
        expected.radar_stamp_ns,
    )
    assert frame.image == expected.image
    assert frame.labels_png in (None, expected.labels_png)
    np.testing.assert_array_equal(frame.lidar_xyz_m, expected.lidar_xyz_m)
    np.testing.assert_array_equal(frame.lidar_intensity, expected.lidar_intensity)
    np.testing.assert_array_equal(frame.radar_xyz_m, expected.radar_xyz_m)
    np.testing.assert_array_equal(frame.radar_range_rate_mps, expected.radar_range_rate_mps)
    np.testing.assert_array_equal(frame.camera_K, expected.camera_K)
    for pair in frame.priors.keys() & expected.priors.keys():  # a moment without a sweep carries camera-radar
        np.testing.assert_array_equal(frame.priors[pair], expected.priors[pair])
