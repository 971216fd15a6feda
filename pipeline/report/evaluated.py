"""Which runs the page of `evaluate` shows, and how: from compared runs and their lake to the page's plain values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.report.evaluation import EvaluatedRun, TableView, View, evaluation_page
from pipeline.report.overlays import Extrinsics, Scene
from pipeline.report.scenes import choose_frames
from pipeline.report.time_offsets import as_stamped, time_offsets_of
from pipeline.rig.differences import ComparedRun
from pipeline.rig.se3 import transform_points
from pipeline.store.current import prior_of, targets_of, transform_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import frames_of, ingested, observations_of, perceived
from schemas.calibrations import PAIRS, CalibrationRecord

__all__ = ["page_of_runs"]

_FAVOURITES = ("joint", "joint-ssl", "joint-optimisation")  # whose pictures are worth a look, best first


def page_of_runs(lake: Lake, compared: Sequence[ComparedRun], texts: Mapping[str, str]) -> str:
    """HTML of the tables, of every run, and of a frame per environment where the lake still has frames.

    Args:
        lake: of the runs; frames and observations are read for the pictures.
        texts: tables as Markdown, by title; lines that begin with "- " are notes.
    """
    by_method: dict[str, list[np.ndarray]] = {}
    for c in compared:
        if len(c.comparison.normalised):
            by_method.setdefault(c.comparison.method, []).append(c.comparison.normalised)
    return evaluation_page(
        [_table(title, text) for title, text in texts.items()],
        [_evaluated(c) for c in compared],
        _views(lake, compared),
        {method: np.concatenate(parts) for method, parts in by_method.items()},
        [line[2:] for text in texts.values() for line in text.splitlines() if line.startswith("- ")],
        no_views="the lake no longer has the days' frames and observations",
    )


def _table(title: str, text: str) -> TableView:
    """The lines of a Markdown table."""
    block = text.split("\n\n")[1].splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in block if line.startswith("|")]
    return TableView(title, cells[0], [(row[0].startswith("paper:"), row) for row in cells[2:]])


def _evaluated(compared: ComparedRun) -> EvaluatedRun:
    first = compared.run["lidar_radar"]
    T, T_prior = transform_of(first), prior_of(first)
    assert T is not None, "compared runs have a result"
    if compared.picks is not None:
        radar, lidar = compared.picks.radar_m, compared.picks.lidar_m
    else:
        assert compared.truth is not None, "either truth or picks"
        radar = targets_of(first)
        lidar = transform_points(compared.truth["lidar_radar"], radar)
    return EvaluatedRun(
        f"{first.vehicle} {first.day}",
        first.method,
        _in_degrees(compared.comparison.errors),
        _in_degrees(compared.comparison.prior_errors),
        lidar,
        transform_points(T if T_prior is None else T_prior, radar),
        transform_points(T, radar),
    )


def _in_degrees(errors: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {pair: np.array([*np.degrees(errors[pair][:2]), errors[pair][2]]) for pair in PAIRS}


def _views(lake: Lake, compared: Sequence[ComparedRun]) -> list[View]:
    """A day of each environment, split into both states; and the run that started furthest off, state by state."""
    best = [c for c in compared if _rank(c) == min(map(_rank, compared))] if compared else []
    wanted = {
        c.comparison.environment: (c, f"{c.comparison.environment}: alignment", True) for c in reversed(best)
    }
    chosen = list(wanted.values())
    if best:
        worst = max(best, key=_start_deg)
        chosen.append((worst, f"Abrupt change: a start {_start_deg(worst):.1f} deg off", False))
    views = []
    for c, title, split in chosen:
        drawn = _scene(lake, c.run, another=not split)
        if drawn is not None:
            first = c.run["camera_lidar"]
            views.append(View(title, *drawn, split, f"{first.vehicle} {first.day}, {first.method}."))
    return views


def _rank(compared: ComparedRun) -> int:
    method = compared.comparison.method
    return _FAVOURITES.index(method) if method in _FAVOURITES else len(_FAVOURITES)


def _start_deg(compared: ComparedRun) -> float:
    """Largest error of the run's prior, azimuth or elevation of any pair."""
    return float(np.degrees(max(e[:2].max() for e in compared.comparison.prior_errors.values())))


def _scene(
    lake: Lake, run: Mapping[str, CalibrationRecord], *, another: bool
) -> tuple[Scene, Extrinsics, Extrinsics] | None:
    """A frame with much to see, and the run's two states, the result with its time offsets; None without frames."""
    first = run["camera_lidar"]
    partition = Partition(first.vehicle, first.day)
    if ingested(lake, partition) is None or perceived(lake, partition) is None:
        return None
    states = []
    for of in (prior_of, transform_of):
        known = [
            T for pair in ("camera_lidar", "camera_radar", "lidar_radar") if (T := of(run[pair])) is not None
        ]
        if len(known) < len(PAIRS):
            return None
        states.append(Extrinsics(*known))
    rows = list(observations_of(lake, partition))
    if not rows:
        return None
    picked = [rows[i] for i in choose_frames(rows, states[1].T_camera_lidar, 2)]
    o = picked[-1 if another else 0]
    frames = list(frames_of(lake, partition, [o.frame_index]))
    if not frames:
        return None
    return Scene(frames[0], o), states[0], as_stamped(states[1], o, time_offsets_of(run))
