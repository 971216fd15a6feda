import pickle
from pathlib import Path

import pytest

from pipeline.core.config import FleetConfig, config_hash, load_fleet
from pipeline.core.errors import ConfigError
from pipeline.core.rigs import PriorConfig, Section
from pipeline.rig.day_prior import require_named_files
from tests.makers.fleet_files import fleet_toml

GOOD = fleet_toml("car-1")


def load(tmp_path, text):
    path = tmp_path / "fleet.toml"
    path.write_text(text)
    return load_fleet(path)


def test_a_small_file_is_enough_and_defaults_are_physical(tmp_path):
    fleet = load(tmp_path, GOOD)
    assert fleet.rig_of("car-1").prior == PriorConfig()
    assert fleet.ingest.sync_gate_s is None
    assert (fleet.ingest.sync_gate_m, fleet.ingest.sync_gate_deg) == (2.5, 2.0)
    assert fleet.rigs["default"].ego is None
    coarse = load(tmp_path, GOOD + "[prepare.grid]\nstep_deg = 0.3\n").prepare.grid
    assert coarse.shape == (176, 304)  # 52.8 by 91.2 deg in multiples of 16 cells


WRONG = {
    "[ingest]\nsync_gate_s = 0": "ingest.sync_gate_s",
    "[select]\nholdout_fraction = 1.0": "select.holdout_fraction",
    "[rigs.default.prior]\nsource = 'file'": "prior",
    "[rigs.default.prior]\nrotation_sigma_deg = 181": "prior.rotation_sigma_deg",
    "[rigs.default.prior]\ntranslation_sigma_m = 1e9": "prior.translation_sigma_m",
    "[audit]\nmethod = 'best'": "audit.method",
    "[audit]\nwindow_days = 1_000_000_000": "audit.window_days",
    "[perceive]\nlabel_scale = 1e-9": "perceive.label_scale",
    "[solve]\nsearch_rotation_deg = 1e9": "solve.search_rotation_deg: 1e+09 deg",
    "[solve]\nseed = -1": "solve.seed",
    "[prepare.grid]\nstep_deg = 0.25": "prepare.grid.step_deg",
}


@pytest.mark.parametrize(
    ("change", "key"),
    [
        *((("[fleet]", f"{section}\n[fleet]"), key) for section, key in WRONG.items()),
        (("[fleet]", "[fleet]\ncolour = 1"), "fleet.colour"),
        (('"/radar/points"', '"/radar/points"\ndoppler_period_mps = -1'), "doppler_period_mps"),
        (('points = "/radar/points"', 'points = "radar"'), "rigs.default.radar.points"),
        (('source = "topics"', 'source = "magic"'), "semantics"),
        (('rig = "default"', 'rig = "other"'), "vehicles.car-1.rig"),
        (('name = "tests"', ""), "fleet.name"),
        (('points = "/radar/points"', 'points = "/lidar/points"'), "/lidar/points"),
        *(
            (("car-1", name), said)
            for name, said in (
                ("a/b", "a/b"),
                ("", "vehicle's name"),
                ("../../etc", "../../etc"),
                (300 * "v", "vehicle's name"),
            )
        ),
    ],
)
def test_what_cannot_be_right_is_refused_by_the_name_of_its_key(change, key, tmp_path):
    assert change[0] in GOOD
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, GOOD.replace(*change, 1))
    assert key in str(caught.value)
    assert "fleet.toml" in str(caught.value)
    assert caught.value.exit_code == 2


def test_every_section_has_at_most_twelve_keys():
    def sizes(kind):
        inner = [type(f.default) for f in kind.model_fields.values() if isinstance(f.default, Section)]
        own = {kind.__name__: len(kind.model_fields) - len(inner)}
        return own | {name: size for k in inner for name, size in sizes(k).items()}

    found = sizes(FleetConfig)
    assert found.keys() >= {"SplitConfig", "GridConfig", "ChecksConfig", "SolveConfig"}
    assert {name: size for name, size in found.items() if size > 12} == {}


def test_a_missing_file_and_an_unknown_vehicle_are_named(tmp_path):
    with pytest.raises(ConfigError, match="no such file"):
        load_fleet(tmp_path / "nowhere.toml")
    with pytest.raises(ConfigError, match=r"car-2.*car-1"):
        load(tmp_path, GOOD).rig_of("car-2")


def test_all_problems_are_told_at_once(tmp_path):
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, GOOD.replace("[fleet]", "[ingest]\nsync_gate_s = 0\nfoo = 1\n[fleet]"))
    assert "ingest.sync_gate_s" in str(caught.value)
    assert "ingest.foo" in str(caught.value)


def test_the_hash_changes_with_every_value_and_not_with_how_it_was_written(tmp_path):
    a = load(tmp_path, GOOD + "[ingest]\nsync_gate_s = 0.005\n")
    b = load(tmp_path, GOOD + "[ingest]\nsync_gate_s = 5e-3\n")
    c = load(tmp_path, GOOD + "[ingest]\nsync_gate_s = 6e-3\n")
    assert config_hash(a.ingest) == config_hash(b.ingest) != config_hash(c.ingest)
    assert config_hash(load(tmp_path, GOOD).ingest) != config_hash(a.ingest)
    assert config_hash(a.ingest, {"x": 1}) != config_hash(a.ingest, {"x": 2})


def test_a_configuration_knows_its_file_through_copies_changes_and_other_processes(tmp_path):
    fleet = load(tmp_path, GOOD)
    ways = [
        fleet,
        fleet.model_copy(update={"solve": fleet.solve}),
        fleet.changed(solve={"seed": 3}),
        pickle.loads(pickle.dumps(fleet)),
    ]
    for known in ways:
        assert known.file == tmp_path / "fleet.toml"
        assert known.path_of("prior.json") == tmp_path / "prior.json"
        assert known.path_of("/etc/prior.json") == Path("/etc/prior.json")
        with pytest.raises(ConfigError) as caught:
            known.rig_of("tram")
        assert caught.value.file == str(tmp_path / "fleet.toml")


def test_changed_sections_are_validated_and_keep_what_dumps_leave_out(tmp_path):
    semantics = 'semantics = { source = "onnx", segmenter = "seg.toml" }'
    fleet = load(tmp_path, GOOD.replace('points = "/lidar/points"', f'points = "/lidar/points"\n{semantics}'))
    changed = fleet.changed(solve={"seed": 3}, select={"frames": 7})
    assert (changed.solve.seed, changed.select.frames, changed.ingest) == (3, 7, fleet.ingest)
    assert changed.rig_of("car-1").lidar.semantics is fleet.rig_of("car-1").lidar.semantics is not None
    assert fleet.solve.seed == 0
    for wrong, key in (({"solve": {"colour": 1}}, "solve.colour"), ({"paint": {"red": 1}}, "paint")):
        with pytest.raises(ConfigError) as caught:
            fleet.changed(**wrong)
        assert caught.value.key == key


def test_what_calibration_takes_as_known_of_a_camera_is_no_reason_to_ingest_its_logs_again(tmp_path):
    info = 'info = "/camera/info"'
    assert info in GOOD
    plain = load(tmp_path, GOOD).rig_of("car-1")
    rolling = load(tmp_path, GOOD.replace(info, f"{info}\nreadout_s = 0.03", 1)).rig_of("car-1")
    assert (plain.camera.known.readout_s, rolling.camera.known.readout_s) == (0.0, 0.03)
    assert plain.model_dump() == rolling.model_dump()
    with pytest.raises(ConfigError, match="readout_s"):
        load(tmp_path, GOOD.replace(info, f"{info}\nreadout_s = 30", 1))


@pytest.mark.parametrize(
    ("section", "key"),
    [
        ('[rigs.default.prior]\nsource = "file"\nfile = "prior.json"', "rigs.default.prior.file"),
        (
            '[rigs.default.lidar.semantics]\nsource = "onnx"\nsegmenter = "points.toml"',
            "lidar.semantics.segmenter",
        ),
        ('[rigs.default.radar.drivable]\nsource = "onnx"\nmodel = "drivable.toml"', "radar.drivable.model"),
        ('[learn]\nmodel = "network.onnx"', "learn.model"),
        ('[learn.pairwise_models]\ncamera_lidar = "pair.onnx"', "learn.pairwise_models.camera_lidar"),
    ],
)
def test_a_file_that_the_configuration_names_is_missed_before_any_log_is_opened(section, key, tmp_path):
    fleet = load(tmp_path, f"{GOOD}\n{section}\n")
    with pytest.raises(ConfigError, match="no such file") as caught:
        require_named_files(fleet)
    assert key in str(caught.value)
    assert caught.value.exit_code == 2
