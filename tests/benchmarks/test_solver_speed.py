"""Whole solutions of a day against SciPy's differential evolution on the same objectives in plain NumPy.

SciPy's side is priced, not run (it would take hours): its evaluations times the CPU time of one evaluation in NumPy, on
the same frames and points. Its own bookkeeping and its final search are left out, which favours it.

Source: evidence on performance, benchmark definition 7 (30 frames).
"""

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState
from pipeline.calibrate.joint.solve import solve_joint
from pipeline.calibrate.numerics.bias_floors import OUTLIER_DENSITY
from pipeline.calibrate.paper.pairwise import solve_pairwise
from pipeline.config import SolveConfig
from pipeline.extrinsics.estimates import Prior
from pipeline.geometry.se3 import perturb_exactly
from pipeline.objective.camera_lidar.own_motion import lidar_velocities
from pipeline.objective.camera_lidar.score import KernelSettings, prepare_terms
from pipeline.objective.paper.camera_lidar import camera_lidar_loss
from pipeline.objective.paper.camera_radar import camera_radar_loss
from pipeline.objective.paper.lidar_radar import lidar_radar_loss
from pipeline.objective.radar.registration import BOUNCE_PRIOR, SIGMA_START, registration_frames
from schemas.calibrations import PAIRS
from tests.benchmarks import numpy_objectives
from tests.benchmarks.kernel_workload import best_cpu_s
from tests.makers.simulated_days import simulated_day

FRAMES, ROUNDS = 30, 2
CONFIG = SolveConfig()
# The paper's effort: first population and generations.
EVALUATIONS = CONFIG.paper_population * (1 + CONFIG.paper_generations)
MOST_POINTS = 18000  # of edges, and of markings: as many as the refinement of joint takes


@pytest.fixture(scope="module")
def day(tmp_path_factory):
    """Observations of every pair, and a prior 2 deg and 0.1 m off."""
    made = simulated_day(tmp_path_factory.mktemp("solver"), frames=FRAMES)
    rng = np.random.default_rng(0)
    camera, radar = (
        perturb_exactly(made.truth[pair], np.radians(2.0), 0.1, rng)
        for pair in ("camera_lidar", "lidar_radar")
    )
    return made.observations, Prior(camera, radar, np.radians(2.0), 0.1)


def test_a_joint_day_costs_a_fraction_of_scipy_on_numpy(day, gate):
    rows, prior = day
    velocity = lidar_velocities(rows, prior.T_lidar_radar)
    terms = prepare_terms(rows, prior.T_camera_lidar, velocity, reach_rad=np.radians(8.0)).sharp(5.0)
    terms = terms.in_view(prior.T_camera_lidar, np.radians(2.0)).at_most(
        MOST_POINTS, np.random.default_rng(0)
    )
    at, settings = AlignmentState(prior.T_camera_lidar).alone, KernelSettings.wide(1.5, 2)
    frames = registration_frames(rows, prior.T_lidar_radar, np.random.default_rng(0))

    def registration():
        T, sigma = prior.T_lidar_radar, SIGMA_START
        return numpy_objectives.registration_cost(frames, T, 0.0, sigma, BOUNCE_PRIOR, OUTLIER_DENSITY)

    score_s, registration_s, joint_s = best_cpu_s(
        ROUNDS,
        lambda: numpy_objectives.score(terms, at, settings),
        registration,
        lambda: solve_joint(dict.fromkeys(PAIRS, rows), prior, CONFIG, seed=0),
    )
    scipy_s = EVALUATIONS * (score_s + registration_s)
    print(f"\njoint {joint_s:.2f} CPU s; SciPy {EVALUATIONS} x ({score_s:.4f} + {registration_s:.4f}) s")
    gate("joint_day_vs_scipy", scipy_s / joint_s)


def test_a_day_by_the_papers_losses_costs_a_fraction_of_scipy_on_numpy(day, gate):
    rows, prior = day
    margin = np.radians(CONFIG.search_rotation_deg)
    losses = {
        "camera_lidar": camera_lidar_loss(rows, prior.T_camera_lidar, margin),
        "camera_radar": camera_radar_loss(rows, prior.T_camera_radar, margin),
        "lidar_radar": lidar_radar_loss(rows),
    }
    plain = numpy_objectives.paper_losses(rows, losses)
    solutions = []
    paper_s, *each_s = best_cpu_s(
        ROUNDS,
        lambda: solutions.append(solve_pairwise(dict.fromkeys(PAIRS, rows), prior, CONFIG, seed=0)),
        *(lambda pair=pair: plain[pair](prior.of(pair)) for pair in PAIRS),
    )
    looked = [solutions[0].pairs[pair].diagnostics["evaluations"] for pair in PAIRS]
    scipy_s = float(np.dot(looked, each_s))
    print(
        f"\npairwise-optimisation {paper_s:.2f} CPU s; {sum(looked):.0f} evaluations, SciPy {scipy_s:.0f} s"
    )
    gate("paper_day_vs_scipy", scipy_s / paper_s)
