"""What `boresight verify` takes as the calibration in use of a rig of many sensors."""

import json
from pathlib import Path

import numpy as np
import pytest

from jobs.calibration_sources import FrameOptions, poses_in_use
from jobs.verify import with_calibration
from pipeline.core.config import load_fleet
from pipeline.core.errors import ConfigError
from pipeline.rig.day_prior import read_star
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake
from schemas.calibrations import CALIBRATIONS
from schemas.poses import POSES
from tests.export.test_import_rig import FLEET, OTHERS, T_TOP, exported
from tests.makers.rig_records import pose_rows, rig_records


@pytest.fixture
def fleet(tmp_path):
    (tmp_path / "fleet.toml").write_text(FLEET)
    return load_fleet(tmp_path / "fleet.toml")


def in_use(fleet, folder, text, lake=None):
    return with_calibration(folder / "written.json", fleet, "van-1", text, lake, FrameOptions())


@pytest.mark.parametrize("form", ["urdf", "autoware", "kalibr"])
def test_it_takes_what_export_writes_and_goes_on_without_sensors_that_the_files_lack(form, fleet, tmp_path):
    files = [
        f for f in exported(tmp_path, form, [s for s in OTHERS if s.name != "left"]) if "provenance" not in f
    ]
    text = f"{form}:{','.join(f for f in files if not f.endswith('.xacro'))}"
    config, lacking = in_use(fleet, tmp_path, text)
    assert [s.name for s in lacking] == ["left"]
    rig = config.rig_of("van-1")
    assert rig.sensors == ("front", "side", "top", "bumper", "corner")
    assert fleet.rig_of("van-1").sensors != rig.sensors  # what was given stays
    star = read_star(Path(rig.prior.file), rig)
    for name in ("front", "side", "bumper", "corner"):
        np.testing.assert_allclose(star["top", name], T_TOP[name], atol=1e-9)


def test_a_prior_file_is_taken_as_it_is(fleet, tmp_path):
    file = tmp_path / "in_use.json"
    file.write_text(json.dumps({"reference": "top", "T": {n: T.tolist() for n, T in T_TOP.items()}}))
    config, lacking = in_use(fleet, tmp_path, str(file))
    assert (config.rig_of("van-1").prior.file, lacking) == (str(file), [])


def test_a_day_of_a_lake_is_taken_by_its_poses(fleet, tmp_path):
    lake = Lake.at(tmp_path / "lake")
    commit_records(lake, CALIBRATIONS, rig_records("van-1", 1, np.random.default_rng(2)))
    commit_records(lake, POSES, pose_rows("van-1", 1, np.random.default_rng(3)))
    config, lacking = in_use(fleet, tmp_path, "2026-03-01", str(lake.root))
    assert [s.name for s in lacking] == ["side"]
    assert len(read_star(Path(config.rig_of("van-1").prior.file), config.rig_of("van-1"))) == 4


def test_what_is_no_calibration_is_refused_in_words(fleet, tmp_path):
    with pytest.raises(ConfigError, match="is neither FORMAT:FILE nor"):
        in_use(fleet, tmp_path, "car.urdf")
    files = exported(tmp_path, "urdf", OTHERS[:1])
    (tmp_path / "urdf" / "sensors.urdf").write_text('<robot name="r"><link name="a"/></robot>')
    with pytest.raises(ConfigError, match="no chain joins these frames"):
        poses_in_use(f"urdf:{files[0]}", None, "van-1", fleet.rig_of("van-1"), FrameOptions())
