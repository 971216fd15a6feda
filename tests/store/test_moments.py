"""Moments and the files of their sensors: all of one work or none, any sensors of a rig joined."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.core.errors import ContractError, DamagedError
from pipeline.store.moments import is_whole, joined, sensor_files, write_moments
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import frames_of, ingested, observations_of
from schemas.moments import FILES, MOMENTS, PRIOR
from tests.makers.lakes import joined_of, write_frames, write_observations
from tests.makers.table_rows import make_frame, make_observation, same

DAY = Partition("car", "2026-03-02")


def frames(count, **values):
    rng = np.random.default_rng(3)
    return [
        make_frame(rng, frame_index=i, stamp_ns=i * 10**8, lidar_stamp_ns=i * 10**8, **values)
        for i in range(count)
    ]


def write_two_cameras(lake, count=5, key="key"):
    """A rig of two cameras, a lidar and a radar; the left camera misses each other moment."""
    rows = frames(count)
    T = np.eye(4)
    T[:3, 3] = 1.0, 2.0, 3.0
    prior = [
        {"log": "a.mcap", "parent": parent, "child": child, "q": [1.0, 0.0, 0.0, 0.0], "t_m": [x, 0.0, 0.0]}
        for parent, child, x in (("front", "top", 1.0), ("left", "top", 2.0), ("top", "nose", 4.0))
    ]
    with write_moments(lake, MOMENTS, DAY, key) as writer:
        for i, frame in enumerate(rows):
            moment, found = joined_of(frame)
            captures = {"front": found["camera"], "top": found["lidar"], "nose": found["radar"]}
            if i % 2 == 0:
                captures["left"] = replace(found["camera"], image=b"left", stamp_ns=i * 10**8 + 5)
            writer.append(moment, captures)
        writer.describe(kept={}, rejected={}, **{PRIOR: prior})
    return rows


@pytest.mark.parametrize("sensors", [["camera", "lidar", "radar"], ["lidar", "radar"], ["camera", "lidar"]])
def test_frames_and_observations_come_back_as_they_were(sensors, lake):
    rng = np.random.default_rng(1)
    priors = {"camera_lidar": np.eye(4), "lidar_radar": np.diag([-1.0, -1.0, 1.0, 1.0])}
    wanted = {pair: T for pair, T in priors.items() if set(pair.split("_")) <= set(sensors)}
    rows = frames(20, sensors=sensors, priors=wanted)
    write_frames(lake, DAY, rows)
    found = list(frames_of(lake, DAY))
    if len(sensors) == 3:
        assert all(
            same(replace(a, priors={}), replace(b, priors={})) for a, b in zip(rows, found, strict=True)
        )
    assert [f.sensors for f in found] == [sensors] * 20
    for pair, T in wanted.items():
        np.testing.assert_allclose(found[7].priors[pair], T, atol=1e-15)
    assert found[3].stamp_ns == rows[3].stamp_ns
    seen = [make_observation(rng, frame_index=i, stamp_ns=i, priors={}) for i in range(20)]
    write_observations(lake, DAY, seen)
    again = list(observations_of(lake, DAY, [19, 2, 7]))
    assert [o.frame_index for o in again] == [2, 7, 19]
    assert all(same(a, seen[a.frame_index]) for a in again)


def test_a_view_is_of_the_sensors_that_are_chosen(lake):
    rows = write_two_cameras(lake)
    left = list(frames_of(lake, DAY, chosen={"camera": "left", "lidar": "top", "radar": "nose"}))
    assert [len(f.sensors) for f in left] == [3, 2, 3, 2, 3]
    assert (left[0].image, left[1].image) == (b"left", b"")
    assert left[2].camera_stamp_ns == left[2].stamp_ns + 5
    assert left[0].priors["camera_lidar"][0, 3] == 2.0
    front = list(frames_of(lake, DAY))  # the first of each kind
    assert [f.image for f in front] == [f.image for f in rows]
    two = {"camera": "left", "radar": "nose"}
    assert [f.frame_index for f in frames_of(lake, DAY, chosen=two)] == [0, 2, 4]
    assert next(frames_of(lake, DAY, chosen=two)).priors["camera_radar"][0, 3] == 6.0  # through the lidar
    moments = [moment for moment, _ in joined(lake, MOMENTS, DAY, ["left"])]
    assert [m.rows.get("left") for m in moments] == [0, None, 1, None, 2]


def test_files_lie_by_table_day_and_sensor_and_those_of_gone_sensors_go(lake):
    write_two_cameras(lake)
    names = sorted(str(p.relative_to(lake.root)) for p in lake.root.rglob("*.parquet"))
    of_day = "vehicle=car/day=2026-03-02"
    assert names == [
        f"images/{of_day}/front.parquet", f"images/{of_day}/left.parquet", f"moments/{of_day}/part-0.parquet",
        f"scans/{of_day}/nose.parquet", f"sweeps/{of_day}/top.parquet",
    ]  # fmt: skip
    tables = {"front": "images", "top": "sweeps", "nose": "scans", "left": "images"}
    assert ingested(lake, DAY).extra[FILES] == tables
    write_frames(lake, DAY, frames(2))
    assert sorted(p.stem for p in sensor_files(lake, MOMENTS, DAY)) == ["camera", "lidar", "radar"]


def test_a_file_of_other_work_is_not_read_with_these_moments(lake, tmp_path):
    write_two_cameras(lake, key="one")
    other = Lake.at(tmp_path / "other")
    write_two_cameras(other, key="two")
    assert is_whole(lake, DAY, ingested(lake, DAY))
    path = lake.file("sweeps", DAY, "top")
    path.write_bytes(other.file("sweeps", DAY, "top").read_bytes())
    assert not is_whole(lake, DAY, ingested(lake, DAY))
    with pytest.raises(ContractError, match=r"top\.parquet.*run `boresight ingest` again"):
        list(frames_of(lake, DAY))
    path.unlink()
    assert not is_whole(lake, DAY, ingested(lake, DAY))
    path.write_bytes(b"PAR1")
    with pytest.raises(DamagedError, match=r"top\.parquet"):
        list(frames_of(lake, DAY))


def test_an_error_while_writing_leaves_the_old_day_and_nothing_else(lake):
    write_two_cameras(lake)
    before = sorted(p for p in lake.root.rglob("*") if p.is_file())
    with pytest.raises(RuntimeError), write_moments(lake, MOMENTS, DAY, "k2") as writer:
        for frame in frames(40):
            writer.append(*joined_of(frame))
        raise RuntimeError
    assert sorted(p for p in lake.root.rglob("*") if p.is_file()) == before
    assert len(list(frames_of(lake, DAY))) == 5
