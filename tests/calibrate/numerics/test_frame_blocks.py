"""Scenes by what is seen, and the blocks of frames that follow them."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.calibrate.numerics.covariance import bootstrap_covariance
from pipeline.calibrate.numerics.frame_blocks import (
    SCENE_DEGREES,
    Scenes,
    blocks_of,
    bootstrap_blocks,
    scenes_of,
)
from pipeline.calibrate.select.frames import MIN_FRAMES, hold_out, select_frames
from pipeline.calibrate.verify.day_checks import scene_failures
from pipeline.core.config import SelectConfig
from tests.makers.solve_scenes import make_day


@pytest.fixture(scope="module")
def day():
    return make_day(40, per_drive=20)


def waiting(frame, count, since_s=0.0, step_s=0.5, speed_mps=0.0):
    """The same view again and again, measured anew: each edge some centimetres beside where it was."""
    rng = np.random.default_rng(3)
    return [
        replace(
            frame,
            frame_index=frame.frame_index + k,
            stamp_ns=frame.stamp_ns + int((since_s + k * step_s) * 1e9),
            ego_speed_mps=speed_mps,
            lidar_edge_xyz_m=frame.lidar_edge_xyz_m
            + rng.normal(0, 0.02, frame.lidar_edge_xyz_m.shape).astype(np.float32),
        )
        for k in range(count)
    ]


def test_every_street_that_is_driven_through_is_a_scene(day):
    assert scenes_of(day).tolist() == list(range(40))


@given(at=st.integers(1, 39), count=st.integers(1, 60))
@settings(max_examples=8, deadline=None)
def test_a_wait_at_a_light_is_one_scene_however_long(at, count):
    day = make_day(40, per_drive=20)
    stop = waiting(day[at], count, since_s=0.01, step_s=0.9 / count)
    after = [replace(o, stamp_ns=o.stamp_ns + int(1e9)) for o in day[at + 1 :]]
    scene = scenes_of([*day[: at + 1], *stop, *after])
    assert scene.max() + 1 == 40
    assert np.all(scene[at + 1 : at + 1 + count] == scene[at])


@pytest.mark.parametrize("speed_mps", [0.0, None])
def test_the_same_view_of_another_drive_is_the_scene_that_it_was(day, speed_mps):
    first = waiting(day[0], 5, step_s=0.0, speed_mps=speed_mps)
    again = [replace(o, drive=7) for o in waiting(day[0], 5, since_s=3600.0, speed_mps=speed_mps)]
    scene = scenes_of([*first, *day[1:], *again])
    assert np.all(scene[-5:] == scene[0])
    assert len(np.unique(scene)) == 40


def test_a_log_that_is_there_twice_adds_no_scene_and_no_block(day):
    shift_ns = int(7200e9)
    copied = [replace(o, stamp_ns=o.stamp_ns + shift_ns, drive=o.drive + 2) for o in day]
    assert len(np.unique(scenes_of([*day, *copied]))) == len(np.unique(scenes_of(day)))
    assert len(np.unique(blocks_of([*day, *copied]))) <= len(np.unique(blocks_of(day)))


def test_a_speed_that_says_zero_does_not_hide_a_drive(day):
    """An ambiguous Doppler wraps: at its period the car seems to stand, but its edges do not."""
    wrapped = [replace(o, ego_speed_mps=0.0, drive=0) for o in day]
    assert len(np.unique(scenes_of(wrapped))) >= 10
    assert len(np.unique(scenes_of(waiting(day[0], 40)))) == 1


@given(seed=st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_blocks_hold_whole_scenes_and_do_not_ask_for_their_names(seed):
    rng = np.random.default_rng(seed)
    scene = np.repeat(np.arange(30), rng.integers(1, 9, 30))
    drive = scene // 7
    block = bootstrap_blocks(drive, scene)
    assert all(len(np.unique(block[scene == s])) == 1 for s in range(30))
    names = rng.permutation(30)
    renamed = bootstrap_blocks(drive, names[scene])
    assert np.array_equal(np.equal.outer(block, block), np.equal.outer(renamed, renamed))


def test_a_view_judges_or_fits_as_a_whole(day):
    frames = [o for k, d in enumerate(day) for o in (waiting(d, 12, step_s=0.08) if k % 10 == 5 else [d])]
    held, scene = hold_out(frames, 0.2), scenes_of(frames)
    assert any(h is True for h in held)
    for s in np.unique(scene):
        assert not {True, False} <= {h for h, own in zip(held, scene, strict=True) if own == s}


def test_a_long_wait_does_not_outweigh_the_day(day):
    frames = [*day[:20], *waiting(day[19], 60, since_s=0.02, step_s=0.01), *day[20:]]
    chosen = select_frames(frames, SelectConfig(frames=100), paper=False)
    scene = scenes_of(frames)
    for pair, fit in chosen.fit.items():
        assert np.bincount(scene[fit]).max() <= MIN_FRAMES, pair
        assert len(fit) > 20


def test_a_day_of_one_scene_certifies_nothing_and_says_what_to_drive(day):
    standing = [
        replace(o, camera_stamp_ns=o.stamp_ns, radar_stamp_ns=o.stamp_ns) for o in waiting(day[0], 60)
    ]
    chosen = select_frames(standing, SelectConfig(), paper=False)
    for pair, fit in chosen.fit.items():
        (check,) = scene_failures([standing[i] for i in fit])
        assert check.fault == "few_scenes"
        assert "1 different scene," in check.sentence
        assert any("drive some 100 m further" in what for what in chosen.missing[pair])
    assert scene_failures(day) == []


def scenes_of_equal(count, frames):
    scene = np.repeat(np.arange(count), frames)
    return Scenes(scene, scene)


@pytest.mark.parametrize(("correlation", "expected"), [(0.0, 1.0), (0.5, 2.5), (1.0, 4.0)])
def test_many_scenes_show_by_how_much_their_frames_err_together(correlation, expected):
    rng = np.random.default_rng(0)
    common, own = rng.normal(size=(400, 1, 3)), rng.normal(size=(400, 4, 3))
    gradient = (np.sqrt(correlation) * common + np.sqrt(1 - correlation) * own).reshape(-1, 3)
    assert scenes_of_equal(400, 4).inflation(gradient) == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("count", [1, 2, 4, 20])
@pytest.mark.parametrize("correlation", [0.1, 0.6])
def test_two_sigmas_of_few_scenes_hold_nineteen_of_twenty_values(count, correlation):
    """Days of one unknown, measured once a frame; what frames of a scene share is unknown to the estimate."""
    rng, frames, outside = np.random.default_rng(1), 8, 0
    scenes = scenes_of_equal(count, frames)
    for _ in range(300):
        shared = np.repeat(np.sqrt(correlation) * rng.normal(size=count), frames)
        measured = shared + np.sqrt(1 - correlation) * rng.normal(size=len(shared))
        gradient = (measured - measured.mean())[:, None]
        weight = len(shared) / scenes.scatter(gradient)
        g = weight * gradient
        information = scenes.inflation(g) * g[:, :, None] * g[:, None, :]
        prior = np.full((1, 1), 1e-6)
        variance = bootstrap_covariance(information, -g, prior, scenes.block, rng, 50, SCENE_DEGREES)
        outside += abs(measured.mean()) > 1.96 * np.sqrt(variance[0, 0])
    assert outside / 300 < 0.1
