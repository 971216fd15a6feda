"""What simulated sensors show agrees under the true transforms, and not a degree beside them."""

import cv2
import numpy as np
import pytest

from pipeline.rig.se3 import exp_so3, from_spherical, inverse, to_spherical, transform_points
from pipeline.simulate.sensors.radar import RadarErrors, scan_radar
from pipeline.simulate.world.casting import _cast
from pipeline.simulate.world.materials import LABELS

MOVERS = [LABELS.index(n) for n in ("person", "rider", "car", "truck", "bus", "bicycle")]


def points_in_map(shot, own_time=True):
    """Lidar points in the map: from where the vehicle was when each beam fired, or from where it was at the end."""
    sweep, end = shot.sweep, shot.lidar_stamp_s
    times, column = np.unique(sweep.time_s, return_inverse=True)
    T = shot.scene.ego.poses(end + (times if own_time else np.zeros_like(times)).astype(np.float64))
    T = (T @ shot.mounting["lidar"].T_vehicle)[column]
    return np.einsum("nij,nj->ni", T[:, :3, :3], sweep.xyz_m.astype(np.float64)) + T[:, :3, 3]


def share_on_own_class(shot, turn_rad=0.0, *, behind=False):
    """Share of standing lidar points that the true transforms put on their own class of the label image.

    Of all that it shows, or of what lies behind the camera.
    """
    keep, camera = ~np.isin(shot.sweep.label, MOVERS), shot.mounting["camera"].camera
    in_map, readout_s = points_in_map(shot)[keep], shot.rig["camera"].sheet.readout_s
    points = points_in_camera(shot, in_map, np.zeros(keep.sum()), turn_rad)
    for _ in range(
        2 if readout_s else 0
    ):  # where a point lies says when it was seen, and the other way round
        share = np.clip((camera.project(points)[0][:, 1] + 0.5) / camera.height_px, 0, 1) - 0.5
        points = points_in_camera(shot, in_map, share * readout_s, turn_rad)
    uv, ok = camera.project(points)
    ok &= camera.contains(uv)
    if behind:
        ok &= points[:, 2] < 0
    u, v = ((uv[ok] + 0.5) / 2).astype(int).T
    assert ok.sum() > 50
    return np.mean(shot.image.true_labels[v, u] == shot.sweep.label[keep][ok])


def points_in_camera(shot, points_map, delay_s, turn_rad):
    """Points of the map in the camera of the frame's exposure, each a little later."""
    exposure_s = shot.camera_stamp_s - shot.mounting["camera"].delay_s
    T_map_camera = shot.scene.ego.poses(exposure_s + delay_s) @ shot.mounting["camera"].T_vehicle
    T_map_camera[:, :3, :3] = T_map_camera[:, :3, :3] @ exp_so3(np.array([0.0, turn_rad, 0.0]))
    return np.einsum("nji,nj->ni", T_map_camera[:, :3, :3], points_map - T_map_camera[:, :3, 3])


@pytest.mark.parametrize("name", ["demo", "rosette", "fisheye", "rolling", "tilted"])
def test_lidar_points_fall_on_their_own_class_in_the_image_under_the_true_transforms(
    name, shots, shots_of_rig
):
    street = "urban" if name == "fisheye" else "highway"
    for shot in shots if name == "demo" else [shots_of_rig(name, street)]:
        assert share_on_own_class(shot) > 0.95
        assert share_on_own_class(shot, np.radians(1.0)) < share_on_own_class(shot) - 0.01
        assert name != "fisheye" or share_on_own_class(shot, behind=True) > 0.9


def test_each_beam_is_fired_from_where_the_vehicle_was_at_that_time(shots):
    """Points put into the map at their own times lie on the meshes; all put there at one time, far more do not."""
    off, off_at_one_time = [], []
    for shot in shots:
        standing = shot.moment.standing
        hard = ~np.isin(shot.sweep.label, [*MOVERS, LABELS.index("vegetation")])
        T = shot.scene.ego.poses(np.array([shot.lidar_stamp_s - 0.04]))[0] @ shot.mounting["lidar"].T_vehicle
        origin = (T[:3, 3] - standing.origin).astype(np.float32)
        for own_time, shares in ((True, off), (False, off_at_one_time)):
            rays = (points_in_map(shot, own_time)[hard] - standing.origin).astype(np.float32) - origin
            length = np.linalg.norm(rays, axis=1)
            hit, _, _ = _cast(standing.scene, np.tile(origin, (len(rays), 1)), rays / length[:, None])
            shares.append(np.mean(np.abs(hit - length) > 0.3))
    assert np.mean(off) < 0.04
    assert np.mean(off_at_one_time) > 2 * np.mean(off)


def static_radar(shot, spec=None):
    """A scan without constant errors, its vehicle pose and radar velocity (in the radar frame)."""
    t = shot.moment.t_s
    rng = np.random.default_rng(11)
    spec = spec or shot.rig["radar"].sheet
    scan = scan_radar(shot.moment, shot.scene.ego, shot.mounting["radar"].T_vehicle, spec, RadarErrors(), rng)
    T = shot.scene.ego.poses(np.array([t]))[0] @ shot.mounting["radar"].T_vehicle
    velocity, omega = (v[0] for v in shot.scene.ego.velocities(np.array([t])))
    lever = T[:3, 3] - shot.scene.ego.poses(np.array([t]))[0][:3, 3]
    return scan, T, T[:3, :3].T @ (velocity + np.cross(omega, lever))


def residuals_mps(shot, origin):
    """Range rates beyond those of a world that stands, and the radar's velocity."""
    scan, _, velocity = static_radar(shot)
    xyz = scan.xyz_m[scan.origin == origin]
    residual = scan.range_rate_mps[scan.origin == origin]
    residual = residual + xyz / np.linalg.norm(xyz, axis=1, keepdims=True) @ velocity
    period = shot.rig["radar"].sheet.doppler_period_mps or np.inf
    return residual - (np.round(residual / period) * period if np.isfinite(period) else 0), velocity


@pytest.mark.parametrize("name", ["demo", "corner-left", "corner-right"])
def test_standing_detections_approach_as_fast_as_the_radar_moves(name, shots, shots_of_rig):
    for shot in shots if name == "demo" else [shots_of_rig(name, "urban")]:
        residual, velocity = residuals_mps(shot, origin=0)
        assert len(residual) > 40
        # Doppler noise, and the direction's error times the speed.
        share = 0.01 if name == "demo" else 0.02
        assert np.median(np.abs(residual)) < 0.12 + share * np.linalg.norm(velocity)
        assert name == "demo" or abs(velocity[1]) > 0.5 * np.linalg.norm(velocity)


def test_standing_radar_detections_lie_on_what_the_lidar_sees(shots):
    for shot in shots:
        scan, T_map_radar, _ = static_radar(shot)
        T_map_lidar = shot.scene.ego.poses(np.array([shot.moment.t_s]))[0] @ shot.mounting["lidar"].T_vehicle
        aer = to_spherical(
            transform_points(inverse(T_map_lidar) @ T_map_radar, scan.xyz_m[scan.origin == 0].astype(float))
        )
        aer = aer[(np.abs(aer[:, 0]) < 0.45) & (aer[:, 1] > -0.22) & (aer[:, 1] < 0.12) & (aer[:, 2] < 45)]
        cloud = transform_points(inverse(T_map_lidar), points_in_map(shot))
        nearest = np.linalg.norm(from_spherical(aer)[:, None] - cloud[None], axis=2).min(axis=1)
        assert len(nearest) > 15
        assert np.median(nearest) < 0.6


def test_an_image_shows_a_street(shots):
    for shot in shots:
        image = cv2.imdecode(np.frombuffer(shot.image.jpeg, np.uint8), cv2.IMREAD_COLOR)
        sky, road = (shot.image.true_labels == LABELS.index(n) for n in ("sky", "road"))
        half = cv2.resize(image, sky.shape[::-1], interpolation=cv2.INTER_AREA)
        assert half[sky].mean() > half[road].mean() + 40
        assert len(np.unique(shot.image.true_labels)) >= 6
