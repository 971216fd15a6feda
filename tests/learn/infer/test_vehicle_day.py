"""The vehicle-day by networks: exact with an oracle, the prior with an echo, from frames in the lake to records."""

import json
from dataclasses import replace

import numpy as np
import onnx
import pytest

from jobs.cli import main
from pipeline.calibrate.networks import held_if_unfit
from pipeline.core.config import load_fleet
from pipeline.core.errors import ConfigError, ModelError, SolveError
from pipeline.core.rigs import CameraPrior
from pipeline.learn.export.onnx_file import export_onnx
from pipeline.learn.infer.asking import FrameAnswer
from pipeline.learn.infer.onnx_networks import UNFIT, model_files, models_key, open_networks
from pipeline.learn.infer.single_frame import single_frame_solution
from pipeline.learn.infer.vehicle_day import _travel, solve_by_networks
from pipeline.learn.network.calibration_network import build_network
from pipeline.learn.sample.frame_sample import SampleReason, SampleRejectedError
from pipeline.learn.sample.grid import NetworkConfig
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import exp_se3, inverse, log_se3
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, PAIRS, CalibrationRecord
from tests.learn.infer.test_joint_fit import frame as evidence_of
from tests.makers import training_lakes
from tests.makers.fleet_files import fleet_toml
from tests.makers.solve_scenes import T_CAMERA_LIDAR, T_LIDAR_RADAR, make_day
from tests.makers.stages import calibrate_day

TRUTH = {
    "camera_lidar": T_CAMERA_LIDAR,
    "camera_radar": T_CAMERA_LIDAR @ T_LIDAR_RADAR,
    "lidar_radar": T_LIDAR_RADAR,
}
NOISE = np.array([*np.radians([0.2] * 3), *[0.02] * 3])
DAY = Partition("a", "2026-01-01")


class Oracle:
    """A network that repeats `gain` of its guess's error, and adds noise."""

    def __init__(self, gain=0.1, noise=1.0, composed=False, reach_rad=np.inf, blind_frames=()):
        self.pairs, self.gain, self.noise, self.composed = PAIRS, gain, noise, composed
        self.reach_rad, self.blind_frames = reach_rad, blind_frames
        self.rng = np.random.default_rng(3)
        self.bias_sigma = {}

    def sensors(self, frame, observation, _prior):
        if frame.frame_index in self.blind_frames:
            raise SampleRejectedError(SampleReason.FEW_LIDAR_POINTS)
        assert frame.frame_index == observation.frame_index
        return frame.frame_index

    def evidence(self, _pair, _sensors, _T_camera_lidar):
        return None

    def answer(self, _sensors, guess):
        T = {}
        for pair in self.pairs:
            error = log_se3(guess[pair] @ inverse(TRUTH[pair]))
            known = min(1.0, self.reach_rad / max(np.linalg.norm(error[:3]), 1e-9))
            step = error * (1 - (1 - self.gain) * known)
            T[pair] = exp_se3(step + self.rng.normal(size=6) * NOISE * self.noise) @ TRUTH[pair]
        return FrameAnswer(T, dict.fromkeys(self.pairs, NOISE**2))


def prior_off(angle_rad, shift_m=0.03):
    turn = np.array([1, -1, 1]) * angle_rad / np.sqrt(3)
    shift = np.array([1, -1, 1]) * shift_m
    T_camera_lidar = exp_se3(np.r_[turn, shift]) @ T_CAMERA_LIDAR
    T_lidar_radar = exp_se3(np.r_[-turn, shift]) @ T_LIDAR_RADAR
    return Prior(T_camera_lidar, T_lidar_radar, np.radians(2.0), 0.05)


@pytest.fixture(scope="module")
def frames():
    observations = make_day(40, seed=5)
    return observations, [training_lakes.frame_of(o, np.random.default_rng(0)) for o in observations]


def solve(frames, networks, prior, triggered=PAIRS, seed=0):
    observations, images = frames
    return solve_by_networks(
        dict.fromkeys(PAIRS, observations), prior, networks=networks, triggered=triggered, method="joint-ssl",
        frames=lambda indices: iter([images[i] for i in indices]), seed=seed, clock_sigma_s=0.05,
    )  # fmt: skip


def of_one_frame(frames, network, prior):
    of_it = {"networks": [network], "method": "joint-ssl", "seed": 0}
    return single_frame_solution(frames[1][3], frames[0][3], prior, **of_it)


def errors_deg(solution):
    return {p: np.degrees(log_se3(e.T @ inverse(TRUTH[p]))[:3]) for p, e in solution.pairs.items()}


def test_an_oracle_is_followed_to_the_truth_within_its_sigmas(frames):
    solution = solve(frames, [Oracle()], prior_off(np.radians(1.5)))
    for pair, estimate in solution.pairs.items():
        error = log_se3(estimate.T @ inverse(TRUTH[pair]))
        assert np.abs(error / np.sqrt(np.diag(estimate.covariance))).max() < 3.5, pair
        assert estimate.frames_used == 40
        assert estimate.observable[:3].all()
    assert np.abs(errors_deg(solution)["camera_lidar"]).max() < 0.12
    assert 0 < np.degrees(solution.loop_rotation_rad) < 0.4
    assert solution.failed_checks == {pair: [] for pair in PAIRS}


def test_the_guess_is_iterated_until_a_network_that_corrects_two_degrees_at_once_is_within_reach(frames):
    far = replace(prior_off(np.radians(5)), rotation_sigma_rad=np.radians(5))
    solution = solve(frames, [Oracle(reach_rad=np.radians(2))], far, triggered=["camera_lidar"])
    assert np.abs(errors_deg(solution)["camera_lidar"]).max() < 0.2
    assert np.array_equal(solution.pairs["lidar_radar"].T, far.T_lidar_radar)  # nothing asked for it
    assert solution.pairs["lidar_radar"].frames_used == 0


def test_networks_that_only_repeat_their_guess_leave_every_prior(frames):
    prior = prior_off(np.radians(1.0))
    for composed in (False, True):
        solution = solve(frames, [Oracle(gain=1.0, noise=1e-3, composed=composed)], prior)
        for pair, estimate in solution.pairs.items():
            assert not estimate.observable.any(), pair
            # A loop closed by construction is no check.
            assert (solution.loop_rotation_rad is None) == composed
            assert pytest.approx(prior.of(pair), abs=1e-9) == estimate.T


def test_frames_that_show_too_little_are_counted_and_too_few_refuse_the_day(frames):
    solution = solve(frames, [Oracle(blind_frames=range(10))], prior_off(0.01))
    assert solution.pairs["camera_lidar"].frames_rejected == {"few_lidar_points_in_view": 10}
    assert solution.pairs["camera_lidar"].frames_used == 30
    with pytest.raises(SolveError, match="5 of 40 \\(35 few_lidar_points_in_view\\)"):
        solve(frames, [Oracle(blind_frames=range(35))], prior_off(0.01))


def test_a_day_whose_halves_differ_fails_a_check(frames):
    class Moved(Oracle):
        def answer(self, sensors, guess):
            said = super().answer(sensors, guess)
            step = exp_se3(np.array([0.02, 0, 0, 0, 0, 0]) * (sensors // 5 % 2))
            return replace(said, T={pair: step @ T for pair, T in said.T.items()})

    solution = solve(frames, [Moved()], prior_off(0.01))
    assert "halves" in solution.failed_checks["camera_lidar"][0].sentence


def test_a_flat_radar_keeps_its_elevations(frames):
    observations, images = frames
    flat = [replace(o, radar_has_elevation=False) for o in observations]
    prior = prior_off(np.radians(1.0))
    solution = solve((flat, images), [Oracle()], prior)
    assert solution.pairs["lidar_radar"].observable.tolist()[:3] == [False, False, True]
    assert solution.pairs["camera_lidar"].observable[:3].all()


def test_one_frame_is_a_calibration_with_the_sigma_of_one_frame(frames):
    prior = replace(prior_off(np.radians(5)), rotation_sigma_rad=np.radians(5))
    # One frame errs the same way at every guess: its noise is no scatter.
    found = of_one_frame(frames, Oracle(noise=0.02), prior)
    estimate = found.pairs["camera_lidar"]
    assert np.abs(errors_deg(found)["camera_lidar"]).max() < 0.1
    assert estimate.frames_used == 1
    assert np.sqrt(estimate.covariance[0, 0]) > 0.8 * NOISE[0]


def turn(azimuth_deg):
    return exp_se3(np.array([0.0, np.radians(azimuth_deg), 0.0, 0.0, 0.0, 0.0]))


class Alike(Oracle):
    """A network whose frame looks alike from two places, 5 deg of azimuth apart: it goes to the nearer one."""

    shown = None

    def evidence(self, pair, _sensors, _T_camera_lidar):
        return self.shown if pair == "camera_lidar" else None

    def answer(self, sensors, guess):
        found = super().answer(sensors, guess)
        other = turn(5.0)
        apart = log_se3(guess["camera_lidar"] @ inverse(TRUTH["camera_lidar"]))[1]
        if apart > np.radians(2.5):
            found.T["camera_lidar"] = other @ found.T["camera_lidar"]
        return found


def test_a_frame_that_looks_alike_from_two_places_cannot_tell_and_says_so(frames):
    for shift_deg in (2.0, 3.0):  # of the prior, from where most searches go to either place
        prior = Prior(turn(shift_deg) @ T_CAMERA_LIDAR, T_LIDAR_RADAR, np.radians(2.0), 0.05)
        found = of_one_frame(frames, Alike(noise=0.02), prior)
        for pair in ("camera_lidar", "camera_radar"):
            assert not found.pairs[pair].observable.any()
            np.testing.assert_allclose(found.pairs[pair].T, prior.of(pair), atol=1e-6)
        assert found.pairs["camera_lidar"].diagnostics["ends_apart_deg"] > 1.5
        assert found.pairs["lidar_radar"].observable[2]


def test_evidence_shows_at_which_of_two_places_a_search_ended_where_nothing_fits(frames):
    network = Alike(noise=0.02)
    network.shown = evidence_of(3)
    # More than half of the searches end at the wrong place.
    prior = Prior(turn(3.0) @ T_CAMERA_LIDAR, T_LIDAR_RADAR, np.radians(2.0), 0.05)
    found = of_one_frame(frames, network, prior)
    assert found.pairs["camera_lidar"].observable[:3].all()
    assert np.abs(errors_deg(found)["camera_lidar"]).max() < 0.2


@pytest.mark.parametrize("stamp_sigma_s", [None, 0.001])
def test_stated_stamps_are_believed_and_others_are_errors_of_the_clock_until_frames_say_more(
    frames, stamp_sigma_s
):
    """Each image was taken 50 ms after its sweep, and its stamp says so."""
    late = [replace(o, camera_stamp_ns=o.stamp_ns + 50_000_000) for o in frames[0]]
    prior = replace(prior_off(0.0), camera=CameraPrior(stamp_sigma_s=stamp_sigma_s))
    ways = [_travel(o, prior) for o in late]
    shown = [evidence_of(i, T_CAMERA_LIDAR @ exp_se3(-0.05 * way)) for i, way in enumerate(ways)]
    network = Oracle()
    network.evidence = lambda pair, i, _T: shown[i] if pair == "camera_lidar" else None
    found = solve((late, frames[1]), [network], prior).pairs["camera_lidar"]
    assert found.time_offset_prior_s == pytest.approx(0.05 if stamp_sigma_s is None else 0.0)
    assert found.time_offset_s == pytest.approx(0.0, abs=0.006)
    assert (found.time_offset_sigma_s < 0.0011) == (stamp_sigma_s is not None)
    assert np.abs(np.degrees(log_se3(found.T @ inverse(T_CAMERA_LIDAR))[:3])).max() < 0.12


def exported(folder, *kinds):
    """Untrained networks of the architecture that is cheap to trace and to open."""
    for pairs in kinds:
        network = build_network(NetworkConfig("concat", pairs, width=8, hidden=32))
        export_onnx(network, folder / f"{pairs}.onnx", {})


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    """One day of 24 frames, a fleet.toml, and untrained networks."""
    root = tmp_path_factory.mktemp("day")
    training_lakes.fill(Lake.at(root / "lake"), *("a", "2026-01-01"), 24)
    exported(root, "joint", "camera_lidar")
    names = ", ".join(f'{pair} = "{pair}.onnx"' for pair in PAIRS)
    learn = f'[learn]\nmodel = "joint.onnx"\npairwise_models = {{ {names} }}\niterations = 1\n'
    (root / "fleet.toml").write_text(fleet_toml("a", sections=learn))
    return root


def run(lake, capsys, *more):
    arguments = ["calibrate", "--fleet", str(lake / "fleet.toml"), "--lake", str(lake / "lake")]
    code = main([*arguments, "--vehicle", "a", "--day", "2026-01-01", *more])
    return code, json.loads(capsys.readouterr().out.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["joint-ssl", "pairwise-ssl"])
def test_untrained_networks_make_records_that_nobody_would_drive_by(lake, capsys, method):
    exported(lake, *PAIRS)
    code, told = run(lake, capsys, "--method", method)
    records = [
        r for r in read_records(Lake.at(lake / "lake"), CALIBRATIONS, CalibrationRecord) if r.method == method
    ]
    assert {r.pair for r in records} == set(PAIRS)
    assert code == 3
    camera_lidar = next(r for r in records if r.pair == "camera_lidar")
    assert camera_lidar.status == "held"
    assert camera_lidar.diagnostics["answers"] > 0
    assert run(lake, capsys, "--method", method) == (code, told)
    again = read_records(Lake.at(lake / "lake"), CALIBRATIONS, CalibrationRecord)
    assert [r.asserted_at for r in again if r.method == method] == [r.asserted_at for r in records]
    assert told["work_key"] == records[0].work_key


@pytest.mark.slow
def test_one_frame_on_the_command_line_prints_transforms_and_records_nothing(lake, capsys):
    before = len(read_records(Lake.at(lake / "lake"), CALIBRATIONS, CalibrationRecord))
    code, told = run(lake, capsys, "--frame", "7", "--perturb", "2,0.05")
    assert (code, told["method"], told["frame_index"]) == (0, "joint-ssl", 7)
    assert set(told["estimates"]) == set(PAIRS)
    T = np.array(told["estimates"]["camera_lidar"]["T"])
    assert T[:3, :3] @ T[:3, :3].T == pytest.approx(np.eye(3), abs=1e-9)
    page = lake / "frame.html"
    assert run(lake, capsys, "--frame", "7", "--perturb", "2,0.05", "--page", str(page))[0] == 0
    html = page.read_text()
    assert html.count("data:image/jpeg") >= 1
    assert "from this frame" in html
    assert "http" not in html.replace("http://www.w3.org", "")
    by_stamp = run(lake, capsys, "--frame", str(told["stamp_ns"]), "--perturb", "2,0.05")[1]
    assert by_stamp == told
    assert run(lake, capsys, "--frame", "99")[0] == 2
    assert run(lake, capsys, "--frame", "7", "--method", "tracking")[0] == 2
    assert len(read_records(Lake.at(lake / "lake"), CALIBRATIONS, CalibrationRecord)) == before


def test_another_model_is_other_work(lake, tmp_path):
    fleet = load_fleet(lake / "fleet.toml")
    files = model_files("joint-ssl", fleet)
    assert files == {"joint": lake / "joint.onnx"}
    other = tmp_path / "joint.onnx"
    other.write_bytes((lake / "camera_lidar.onnx").read_bytes())
    assert models_key(files) != models_key({"joint": other})
    with pytest.raises(ModelError, match="estimates camera_lidar, not"):
        open_networks({"joint": other}, fleet.learn, fleet.prepare)


def with_card(path, out, **more):
    model = onnx.load(path)
    card = next(p for p in model.metadata_props if p.key == "card")
    card.value = json.dumps(json.loads(card.value) | more)
    onnx.save(model, out)
    return {"joint": out}


def test_a_card_may_say_by_what_all_answers_are_off_alike(lake, tmp_path):
    fleet = load_fleet(lake / "fleet.toml")
    files = model_files("joint-ssl", fleet)
    assert open_networks(files, fleet.learn, fleet.prepare)[0].bias_sigma == {}
    bias = [0.3, 0.2, 0.1, 0.03, 0.02, 0.01]
    told = with_card(files["joint"], tmp_path / "told.onnx", bias_sigma={"lidar_radar": bias})
    [network] = open_networks(told, fleet.learn, fleet.prepare)
    assert network.bias_sigma["lidar_radar"] == pytest.approx([*np.radians(bias[:3]), *bias[3:]])
    for wrong in ({"lidar_radar": [0.3]}, {"sonar": [0.1] * 6}, {"lidar_radar": [-1] * 6}, [1]):
        with pytest.raises(ModelError, match="bias_sigma"):
            other = with_card(files["joint"], tmp_path / "wrong.onnx", bias_sigma=wrong)
            open_networks(other, fleet.learn, fleet.prepare)


def test_a_network_that_was_not_validated_fails_a_check_in_each_of_its_pairs(frames, lake, tmp_path):
    fleet = load_fleet(lake / "fleet.toml")
    files = model_files("joint-ssl", fleet)
    solution, by = solve(frames, [Oracle()], prior_off(0.02)), {}
    for limits in (["Trained without ground truth."], [f"{UNFIT}: trained for 9 steps."]):
        path = with_card(files["joint"], tmp_path / "card.onnx", limits=limits)
        networks = open_networks(path, fleet.learn, fleet.prepare)
        found = held_if_unfit(solution, networks)
        by[networks[0].unfit] = {p: len(e.failed_checks) for p, e in found.pairs.items()}
    fit, unfit = by.values()
    assert list(by) == ["", f"{UNFIT}: trained for 9 steps."]
    assert unfit == {pair: count + 1 for pair, count in fit.items()}


def test_a_missing_model_names_its_key(lake, tmp_path):
    fleet = training_lakes.fleet_of(["a"])
    broken = fleet.changed(learn={"model": "nowhere.onnx"}).read_from(lake / "fleet.toml")
    with pytest.raises(ConfigError, match=r"learn\.model: .*nowhere.onnx does not exist"):
        calibrate_day(DAY, broken, Lake.at(tmp_path), method="joint-ssl")


def test_a_day_without_frames_is_refused_not_crashed(lake, tmp_path):
    training_lakes.fill(Lake.at(tmp_path), "a", "2026-01-01", 24)
    Lake.at(tmp_path).file("moments", DAY).unlink()
    result = calibrate_day(DAY, load_fleet(lake / "fleet.toml"), Lake.at(tmp_path), method="joint-ssl")
    assert result.status == "refused"
    assert "no frames of this day" in result.reason
