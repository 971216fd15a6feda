import json

import numpy as np
import pytest

from pipeline.core.config import load_fleet
from pipeline.core.errors import ConfigError, SolveError
from pipeline.rig.day_prior import rig_prior
from pipeline.rig.prior import from_rows, moved, star_of, to_rows
from pipeline.rig.se3 import adjoint, exp_se3, inverse, log_so3
from tests.rig.test_rig import VAN

NAMES = ("front", "left", "top", "nose", "corner_fl", "corner_rr", "base")


def poses(seed=0):
    """T_base_sensor of the van's sensors."""
    rng = np.random.default_rng(seed)
    return {name: exp_se3(rng.normal(0, 1, 6)) for name in NAMES}


def prior_of(tmp_path, text=VAN, lost=()):
    path = tmp_path / "fleet.toml"
    path.write_text(text)
    fleet = load_fleet(path)
    rig, T = next(iter(fleet.rigs.values())), poses()

    def chain(a, b):
        return None if (a in lost) != (b in lost) else inverse(T[a]) @ T[b]

    rows = json.loads(json.dumps(to_rows([star_of(rig.nodes, chain)])))
    return rig, rig_prior(rows, fleet, rig), T


def test_poses_of_all_sensors_come_back_through_the_manifest(tmp_path):
    _, prior, T = prior_of(tmp_path)
    known = prior.extrinsics()
    assert (known.reference.name, known.order) == (
        "top",
        ("front", "left", "nose", "corner_fl", "corner_rr", "base"),
    )
    for a in NAMES:
        for b in NAMES:
            np.testing.assert_allclose(known.between(a, b), inverse(T[a]) @ T[b], atol=1e-9)
            np.testing.assert_allclose(prior.between(a, b), inverse(T[a]) @ T[b], atol=1e-9)


def test_the_reference_is_mounted_with_a_tolerance_of_its_own_that_all_poses_in_it_share(tmp_path):
    _, prior, T = prior_of(tmp_path)
    known = prior.extrinsics()
    own = np.diag([np.radians(2.0) ** 2] * 3 + [0.05**2] * 3)
    np.testing.assert_allclose(known.covariance_between("top", "base"), own, atol=1e-12)
    A = adjoint(inverse(T["top"]) @ T["left"])
    both = own + A @ known.covariance_between("left", "base") @ A.T
    np.testing.assert_allclose(known.covariance_between("top", "left"), both, atol=1e-12)
    assert prior.sigmas_between("top", "left") == pytest.approx(
        (np.radians(2 * np.sqrt(2)), 0.05 * np.sqrt(2))
    )
    assert prior.sigmas_between("left", "base") == pytest.approx((np.radians(2), 0.05))


def test_sensors_that_no_chain_reaches_are_named_and_know_each_other(tmp_path):
    _, prior, T = prior_of(tmp_path, lost=("corner_rr", "nose"))
    assert [n.name for n in prior.untied] == ["nose", "corner_rr"]
    assert prior.between("top", "nose") is None
    np.testing.assert_allclose(
        prior.between("nose", "corner_rr"), inverse(T["nose"]) @ T["corner_rr"], atol=1e-9
    )
    assert set(prior.extrinsics().T) == set(NAMES) - {"nose", "corner_rr"}
    shaken = moved(prior, 0.03, 0.1, seed=1)
    assert np.array_equal(shaken.between("nose", "corner_rr"), prior.between("nose", "corner_rr"))


def test_a_prior_that_changes_over_the_day_is_refused():
    T = {("top", "nose"): np.eye(4)}
    other = {("top", "nose"): exp_se3(np.array([0, 0, 1e-3, 0, 0, 0]))}
    assert len(to_rows([T, T])) == 1
    with pytest.raises(SolveError, match="top_nose changes over the day"):
        from_rows(to_rows([T, other]))


def test_no_sensor_but_the_reference_stays_where_it_was_and_all_move_by_as_much(tmp_path):
    _, prior, _ = prior_of(tmp_path)
    before, after = prior.extrinsics().T, moved(prior, np.radians(3), 0.1, seed=4)
    for name, T in after.extrinsics().T.items():
        turn = np.degrees(np.linalg.norm(log_so3(T[:3, :3] @ before[name][:3, :3].T)))
        shift = np.linalg.norm(T[:3, 3] - before[name][:3, 3])
        assert (turn, shift) == pytest.approx((0, 0) if name == "top" else (3, 0.1), abs=1e-9)
    assert after.sigmas["front"] == (np.radians(3), 0.1)
    assert after.sigmas["corner_fl"] == (np.radians(4), 0.1)


def test_a_prior_file_says_where_every_sensor_is(tmp_path):
    path = tmp_path / "prior.json"
    text = VAN + '[rigs.van.prior]\nsource = "file"\nfile = "prior.json"\n'
    T = poses()
    given = {"reference": "top", "T": {n: (inverse(T["top"]) @ T[n]).tolist() for n in NAMES if n != "top"}}
    path.write_text(json.dumps(given))
    _, prior, _ = prior_of(tmp_path, text)
    np.testing.assert_allclose(prior.between("left", "base"), inverse(T["left"]) @ T["base"], atol=1e-9)
    wrong = [
        (given | {"reference": "roof"}, "reference: 'roof' is none of front"),
        (given | {"T": {k: v for k, v in given["T"].items() if k != "nose"}}, "lacks nose"),
        (given | {"T": given["T"] | {"roof": np.eye(4).tolist()}}, "has roof, not in the rig"),
        (given | {"T": given["T"] | {"top": (2 * np.eye(4)).tolist()}}, "T.top"),
        (given | {"T": given["T"] | {"top": T["top"].tolist()}}, "the reference's own pose"),
        (given | {"T": given["T"] | {"nose": [[1]]}}, "T.nose: is no 4x4 matrix"),
        ({"T_camera_lidar": np.eye(4).tolist()}, '{"reference": "top", "T": {...}}'),
    ]
    for content, said in wrong:
        path.write_text(json.dumps(content))
        with pytest.raises(ConfigError) as caught:
            prior_of(tmp_path, text)
        assert said in str(caught.value)
        assert "prior.json" in str(caught.value)
