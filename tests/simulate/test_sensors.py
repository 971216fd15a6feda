"""Sensors deliver what their data sheets say, with the errors that were asked for."""

from dataclasses import replace

import cv2
import numpy as np

from pipeline.rig.se3 import to_spherical
from pipeline.simulate.sensors.camera import _exposed
from pipeline.simulate.sensors.lidar import sweep_lidar
from pipeline.simulate.sensors.radar import RadarErrors, scan_radar
from pipeline.simulate.sensors.rigs import rig_named
from pipeline.simulate.sensors.semantics import Box, SemanticsSpec, noisy_boxes, noisy_labels
from pipeline.simulate.world.materials import LABELS


def test_doppler_is_quantised_and_folded_into_one_period(highway):
    shot = highway[0]
    spec = replace(shot.rig["radar"].sheet, doppler_period_mps=10.394, doppler_step_mps=0.0812)
    args = (shot.moment, shot.scene.ego, shot.mounting["radar"].T_vehicle)
    folded = scan_radar(*args, spec, RadarErrors(), np.random.default_rng(3))
    free = scan_radar(*args, replace(spec, doppler_period_mps=None), RadarErrors(), np.random.default_rng(3))
    assert np.abs(folded.range_rate_mps).max() <= 10.394 / 2 + 0.05
    assert np.abs(free.range_rate_mps).max() > 12
    steps = folded.range_rate_mps / 0.0812
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)


def test_a_radar_sees_its_whole_field_and_nothing_beyond_it_or_below_its_threshold(shots):
    sheet = shots[0].rig["radar"].sheet
    azimuth, elevation, range_m = np.concatenate([to_spherical(s.scan.xyz_m.astype(float)) for s in shots]).T
    for angle, half_deg in ((azimuth, sheet.azimuth_deg), (elevation, 1.1 * sheet.elevation_deg)):
        assert 0.93 < np.degrees(np.abs(angle)).max() / half_deg <= 1.0
    assert sheet.min_range_m < range_m.min() < range_m.max() < sheet.max_range_m
    assert min(s.scan.power_db.min() for s in shots) > 30 + 10 * np.log10(12) - 0.01


def test_a_dirty_radar_sees_things_between_them_and_their_image_in_the_road(shots):
    def below_road(rig):
        found = []
        for shot in shots:
            T, sheet = shot.mounting["radar"].T_vehicle, rig_named(rig)["radar"].sheet
            args = (shot.moment, shot.scene.ego, T, sheet, RadarErrors(), np.random.default_rng(3))
            scan = scan_radar(*args)
            found.append(scan.xyz_m[scan.origin == 0] @ T[2, :3] + T[2, 3] < -0.3)
        return np.mean(np.concatenate(found))

    assert below_road("demo-dirty") > 2 * below_road("demo")


def test_a_flat_radar_has_no_elevation_and_sixteen_rings_look_all_around(shots_of_rig):
    shot = shots_of_rig("ring16-flat", "urban")
    sweep, scan = shot.sweep, shot.scan
    assert len(scan.xyz_m) > 30
    assert np.all(scan.xyz_m[:, 2] == 0)
    assert set(np.unique(sweep.ring)) <= set(range(16))
    azimuth = np.arctan2(sweep.xyz_m[:, 1], sweep.xyz_m[:, 0])
    assert np.histogram(azimuth, 8, (-np.pi, np.pi))[0].min() > 50
    assert -0.1 <= sweep.time_s.min() <= sweep.time_s.max() <= 0


def test_paint_is_brighter_than_asphalt_to_camera_and_lidar(highway):
    for shot in highway:
        road = shot.sweep.label == LABELS.index("road")
        near = road & (np.linalg.norm(shot.sweep.xyz_m, axis=1) < 18)
        intensity = shot.sweep.intensity[near]
        bright = intensity > 25
        assert 0.01 < bright.mean() < 0.3
        T_camera_lidar = shot.mounting.between("camera", "lidar")
        p = shot.sweep.xyz_m[near] @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3]
        uv, ok = shot.mounting["camera"].camera.project(p)
        ok &= shot.mounting["camera"].camera.contains(uv)
        image = cv2.imdecode(np.frombuffer(shot.image.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
        u, v = np.round(uv[ok]).astype(int).T
        grey = image[v, u].astype(float)
        assert grey[bright[ok]].mean() > grey[~bright[ok]].mean() + 15


def test_edges_of_objects_give_mixed_points(urban):
    """Some returns lie between two surfaces, so an estimator may not trust each depth jump."""
    shot = urban[0]
    end, args = shot.lidar_stamp_s, (shot.moment, shot.scene.ego, shot.mounting["lidar"].T_vehicle)
    range_of = []
    for spec in (shot.rig["lidar"].sheet, replace(shot.rig["lidar"].sheet, divergence_deg=1e-6)):
        sweep = sweep_lidar(*args, spec, end, np.random.default_rng(0))
        beams = zip(sweep.ring.tolist(), sweep.time_s.tolist(), strict=True)
        range_of.append(dict(zip(beams, np.linalg.norm(sweep.xyz_m, axis=1), strict=True)))
    both = range_of[0].keys() & range_of[1].keys()
    moved = np.array([abs(range_of[0][k] - range_of[1][k]) for k in both])
    assert 0.002 < np.mean(moved > 0.25) < 0.2
    sheet = shot.rig["lidar"].sheet
    assert 0.3 < len(shot.sweep.ring) / (sheet.rows * sheet.columns) < 0.99  # some never come back


def test_labels_err_as_much_as_was_asked_for(shots):
    for shot in shots:
        wrong = []
        for share in (0.0, 0.05, 0.3):
            spec = SemanticsSpec(confusion=share)
            noisy = noisy_labels(shot.image.true_labels, spec, np.random.default_rng(2))
            wrong.append(np.mean(noisy != shot.image.true_labels))
        assert wrong[0] < 0.08  # boundaries alone
        assert wrong[0] < wrong[1] < wrong[2]
        assert wrong[1] < 0.15


def test_boxes_are_missed_jittered_and_invented_at_the_stated_rates():
    rng = np.random.default_rng(4)
    true = [(Box(100.0, 100.0, 200.0, 180.0, "car", 1.0), 2000)]
    found = [noisy_boxes(true, (912, 470), SemanticsSpec(false_boxes=0.0), rng) for _ in range(2000)]
    assert abs(np.mean([not f for f in found]) - 0.04) < 0.015
    left = np.array([f[0].x0 for f in found if f])
    assert abs(left.mean() - 100) < 0.3
    assert 1.5 < left.std() < 3.5
    invented = [noisy_boxes([], (912, 470), SemanticsSpec(), rng) for _ in range(1000)]
    assert abs(np.mean([len(f) for f in invented]) - 0.12) < 0.05


def test_boxes_hold_the_road_users_of_the_label_image(urban):
    cars = urban[0].image.true_labels == LABELS.index("car")
    covered = np.zeros_like(cars)
    for box in urban[0].image.boxes:
        x0, x1, y0, y1 = (round(v / 2) for v in (box.x0, box.x1, box.y0, box.y1))
        covered[max(y0, 0) : y1 + 1, max(x0, 0) : x1 + 1] |= box.name in ("car", "truck")
    assert covered[cars].mean() > 0.7


def test_pixels_beyond_black_and_white_are_black_and_white():
    linear = np.full((60, 80, 3), 0.2, np.float32)
    linear[:20], linear[40:] = -2.3e10, 2.3e10
    image = _exposed(linear, 1.5, 0.0, np.random.default_rng(0))
    assert (image[:18] == 0).all()
    assert (image[42:] == 255).all()
    assert ((image[25:35] > 60) & (image[25:35] < 220)).all()
