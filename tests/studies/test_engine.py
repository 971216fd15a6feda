"""Studies go on where they stopped, from the priors that they promise, on days spoiled as they say."""

from pipeline.core.config import load_fleet
from tests.benchmarks.studies.days import DaySpec, label_by_network
from tests.makers.fleet_files import fleet_toml
from tests.makers.solve_scenes import T_CAMERA_LIDAR, T_LIDAR_RADAR

SPEC = DaySpec(7, "urban")
MEASURED = [prefix + q for prefix in ("", "prior_") for q in ("az_deg", "el_deg", "range_m")]
TRUTH = {
    "T_camera_lidar": T_CAMERA_LIDAR.tolist(),
    "T_lidar_radar": T_LIDAR_RADAR.tolist(),
    "T_camera_radar": (T_CAMERA_LIDAR @ T_LIDAR_RADAR).tolist(),
    "dt_camera_lidar_s": 0.0,
    "dt_lidar_radar_s": 0.0,
    "dt_camera_radar_s": 0.0,
}


def test_a_network_that_labels_a_days_lidar_is_in_its_fleet_file(tmp_path):
    fleet = tmp_path / "fleet.toml"
    fleet.write_text(fleet_toml("car"))
    label_by_network(fleet, "shipped:lidar_semantics")
    [rig] = load_fleet(fleet).rigs.values()
    assert rig.lidar.semantics is not None
    assert rig.lidar.semantics.segmenter == "shipped:lidar_semantics"
