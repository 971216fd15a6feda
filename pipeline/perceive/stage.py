"""Stage perceive: captures of one vehicle-day to features, sensor by sensor, a moment at a time."""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, Final, NamedTuple, cast

import numpy as np

from pipeline.core.config import FleetConfig, PerceiveConfig
from pipeline.core.errors import ModelOutputError
from pipeline.core.rigs import LidarTopics, OnnxSemantics, RadarTopics, TopicSemantics
from pipeline.core.stage_work import NothingUsable, Run, Task, Work
from pipeline.perceive.camera import (
    BatchedSource,
    FrameReason,
    FrameRejectedError,
    SemanticsSource,
    TopicSource,
)
from pipeline.perceive.drivable import DrivableSource
from pipeline.perceive.earlier_greys import EarlierGreys
from pipeline.perceive.ego_velocity import RadarMotion, Travel, radar_motion
from pipeline.perceive.features import (
    deskewed,
    perceive_image,
    perceive_scan,
    perceive_sweep,
    speed_of,
    why_unusable,
)
from pipeline.perceive.ground import PointSource
from pipeline.perceive.tracks import TrackState
from pipeline.perceive.untimed_sweeps import Turning, turning_of
from pipeline.rig.graph import BASE, Kind, Sensor, possible_edges
from pipeline.rig.prior import Star, between
from pipeline.rig.rig import Rig
from pipeline.store.moments import joined, sensors_of
from pipeline.store.views import logged_stars
from schemas.captures import Capture, Sweep
from schemas.faults import FAULTS
from schemas.moments import MOMENTS, PRIOR, SAME_SCENE_NS, Moment, Perceived
from schemas.observations import WITHOUT_LABELS

__all__ = ["AS_LOGGED", "BY_DOPPLER", "WITHOUT_ROWS", "Found", "Shown", "Sources", "perceive_moment", "work"]

# Among the manifest's kept: edges between neighbours, see README.
WITHOUT_ROWS: Final = "frames_without_lidar_rows"
# Likewise, of sweeps that no odometry de-skewed: moved by a radar's velocity, or left, for that was unknown.
BY_DOPPLER: Final = "frames_deskewed_by_doppler"
AS_LOGGED: Final = "frames_not_deskewed"
# Remark on cameras without semantics, with the section of fleet.toml that would give them some.
_REMEDY: Final = (
    "to have labels, name topics or models in {} (`boresight models --fetch` downloads two models)"
)

_Joined = tuple[Moment, dict[str, Any]]


def work(task: Task) -> Work:
    """Features of a day's moments: the partition of `perceived`, and the features of each sensor.

    Unusable sensors are left out of their moment; moments without two sensors are left out, counted by
    reason. If none is left, the partition is empty and the outcome "refused". Of a camera without semantics,
    steps of brightness take the place of labels, with a remark.

    Raises:
        ConfigError: the vehicle is unknown or a manifest is missing.
        ModelError: a model contradicts its manifest.
    """
    rig = task.fleet.rig_of(task.partition.vehicle)
    sources, keys = _sources(rig, task.fleet)
    section = f"[rigs.{task.fleet.vehicle(task.partition.vehicle).rig}.cameras.NAME.semantics]"
    return Work(
        (task.fleet.perceive.keyed(), keys),
        lambda run: _rows(task, sources, section, run),
        nothing="no usable frame",
    )


def _rows(
    task: Task, sources: Sources, section: str, run: Run
) -> Generator[tuple[Perceived, dict[str, Capture]], None, None]:
    """The day's moments with their features, one row group of each sensor in memory at a time."""
    ingested = task.inputs[MOMENTS.name]
    stars, kinds = logged_stars(ingested.extra.get(PRIOR, ())), sensors_of(ingested)
    tracks: dict[str, TrackState] = {}
    whole_ns = -SAME_SCENE_NS
    turning = _turning(task, [s for s, kind in kinds.items() if kind == "lidar"]) if sources.deskew else {}
    moments = _ahead(joined(task.lake, MOMENTS, task.partition), sources)
    for seen, (moment, as_logged) in enumerate(moments, 1):
        timed = {s: turning[s].timed(moment, c) for s, c in as_logged.items() if s in turning}
        captures = as_logged | {s: sweep for s, (sweep, _) in timed.items()}
        shown = Shown(moment, captures, kinds, stars.get(moment.log, {}))
        found: Found | None = None
        try:
            found = perceive_moment(shown, sources, tracks, alone=moment.stamp_ns - whole_ns > SAME_SCENE_NS)
        except FrameRejectedError as rejection:
            run.rejected[rejection.reason.value] += 1
        except ModelOutputError as err:
            raise NothingUsable(f"{FAULTS['model_output']}: {err}", "model_output") from err
        run.progress(seen, ingested.rows, "frames")
        if found is not None:
            tracks = tracks | found.tracks
            whole_ns = whole_ns if found.unusable else moment.stamp_ns
            run.kept.update([*found.notes, *(note for _, note in timed.values() if note)])
            run.rejected.update(f"without_{sensor}_{why.value}" for sensor, why in found.unusable.items())
            yield found.moment, found.features
    unlabelled = [s for s, kind in kinds.items() if kind == "camera" and sources.cameras[s] is None]
    told = [f"{s}: {WITHOUT_LABELS}; {_REMEDY.format(section.replace('NAME', s))}" for s in unlabelled]
    run.remarks = "; ".join([*told, *sources.remarks()])
    run.extra |= {PRIOR: ingested.extra.get(PRIOR, [])}


def _turning(task: Task, lidars: Sequence[str]) -> dict[str, Turning]:
    """Rotation of lidars whose sweeps have no times, by name."""
    rig, found = task.fleet.rig_of(task.partition.vehicle), {}
    for name in lidars:
        moments = joined(task.lake, MOMENTS, task.partition, [name])
        turning = turning_of(((m, c[name]) for m, c in moments if name in c), rig.lidars[name].turn)
        if turning is not None:
            found[name] = turning
    return found


def _ahead(moments: Iterator[_Joined], sources: Sources) -> Generator[_Joined, None, None]:
    """The same moments, `perceive.batch` of them at a time, so that models are shown several images at once."""
    while some := list(islice(moments, sources.config.batch)):
        for name, source in sources.cameras.items():
            images = [captures[name] for _, captures in some if name in captures]
            if len(some) > 1 and images and isinstance(source, BatchedSource):
                source.look_ahead(images)
        yield from some


@dataclass(frozen=True, eq=False)
class Sources:
    """Models and settings by sensor's name; None = geometry, of a camera steps of brightness.

    `deskew` has the sweeps without odometry, which a radar's velocity moves to their stamps.
    """

    cameras: Mapping[str, SemanticsSource | None]
    lidars: Mapping[str, PointSource | None]
    radars: Mapping[str, DrivableSource | None]
    config: PerceiveConfig
    deskew: bool = True
    readouts_s: Mapping[str, float] = field(default_factory=dict)  # of rolling shutters
    earlier: dict[str, EarlierGreys] = field(default_factory=dict)  # of the day so far

    def remarks(self) -> list[str]:
        """Where models run on another provider than the first that fleet.toml names."""
        wanted = self.config.providers[:1]
        found = {s.provider for s in self.cameras.values() if isinstance(s, BatchedSource)}
        return [
            f"models ran on {p}: {wanted[0]} was not available"
            for p in sorted(found.difference(wanted))
            if wanted
        ]


@dataclass(frozen=True, eq=False)
class Shown:
    """A moment with its captures and the prior of its log, sensors by name."""

    moment: Moment
    captures: Mapping[str, Any]
    kinds: Mapping[str, str]
    star: Star

    def of(self, kind: str, usable: Mapping[str, Any]) -> dict[str, Any]:
        """Usable captures of one kind."""
        return {s: c for s, c in usable.items() if self.kinds[s] == kind}

    def heading(self, radar: str, lidar: str | None = None) -> float | None:
        """Azimuth in a radar's axes of the way ahead: the x axis of a lidar, else of the vehicle frame.

        The lidar is the given one, or the first with a known pose.
        """
        lidars = [s for s, kind in self.kinds.items() if kind == "lidar"]
        ahead = [*lidars, BASE.name] if lidar is None else [lidar]
        known = (between(self.star, name, radar) for name in ahead)
        T_ahead_radar = next((T for T in known if T is not None), None)
        return None if T_ahead_radar is None else float(np.arctan2(T_ahead_radar[0, 1], T_ahead_radar[0, 0]))


class Found(NamedTuple):
    """Features of one moment, and the tracks of its radars after it."""

    moment: Perceived
    features: dict[str, Any]
    tracks: dict[str, TrackState]
    notes: list[str]  # WITHOUT_ROWS, BY_DOPPLER, AS_LOGGED of a sweep; why an image shows no motion
    unusable: Mapping[str, FrameReason]  # sensors that the moment goes without


def perceive_moment(
    shown: Shown, sources: Sources, tracks: Mapping[str, TrackState], *, alone: bool = True
) -> Found:
    """Features of a moment, and the radars' tracks updated with it.

    `alone` is true if no complete moment shows the same scene; otherwise a moment without one of its sensors
    is rejected for a rig with one sensor of each kind.

    Raises:
        ModelError: a model contradicts its manifest.
        FrameRejectedError: fewer than two usable sensors, or the moment is not alone.
    """
    moment, config = shown.moment, sources.config
    asked = shown.captures
    unusable = {s: why for s, c in asked.items() if (why := why_unusable(c)) is not None}
    features, notes = dict[str, Any](), list[str]()
    for camera, image in shown.of("camera", _less(asked, unusable)).items():
        try:
            readout_s = sources.readouts_s.get(camera, 0.0)
            earlier = sources.earlier.setdefault(camera, EarlierGreys(readout_s))
            features[camera], still = perceive_image(image, sources.cameras[camera], earlier, config)
            notes += [] if still is None else [f"{camera}_without_motion_{still.value}"]
        except FrameRejectedError as why:
            unusable[camera] = why.reason
    usable = _less(asked, unusable)
    if len(usable) < 2 or (unusable and not _is_worth_having(shown, usable, alone=alone)):
        raise FrameRejectedError(next(iter(unusable.values()), FrameReason.NO_LABELS))
    # One generator per moment: the result does not depend on which came before.
    seed = [moment.stamp_ns & 0x7FFFFFFFFFFFFFFF, moment.moment]
    rng = np.random.default_rng(seed)
    scans, sweeps = shown.of("radar", usable), shown.of("lidar", usable)
    headings = {radar: shown.heading(radar) for radar in scans}

    def motions_by(generator: np.random.Generator) -> dict[str, RadarMotion]:
        return {
            radar: radar_motion(
                scan.radar_xyz_m, scan.radar_range_rate_mps, scan.radar_power_db, scan.doppler_period_mps,
                Travel(moment.ego_speed_mps, headings[radar]), scan.radar_has_elevation, config, generator,
            )
            for radar, scan in scans.items()
        }  # fmt: skip

    skewed = sources.deskew and any(_is_skewed(c) for c in asked.values())
    early = motions_by(np.random.default_rng([*seed, 1])) if skewed else None
    for lidar, sweep in sweeps.items():
        swept = sweep if early is None else _deskewed(shown, lidar, sweep, early)
        features[lidar], has_rows = perceive_sweep(swept, config, rng, sources.lidars[lidar])
        notes += [] if has_rows else [WITHOUT_ROWS]
        if early is not None and _is_skewed(sweep):
            notes.append(AS_LOGGED if swept is sweep else BY_DOPPLER)
    motions = motions_by(rng) if early is None else early
    after = {}
    for radar, scan in scans.items():
        before = tracks.get(radar) or TrackState()
        features[radar], after[radar] = perceive_scan(
            scan, moment, motions[radar], before, sources.radars[radar]
        )
    row = Perceived(
        moment=moment.moment, log=moment.log, drive=moment.drive, stamp_ns=moment.stamp_ns, rows={},
        ego_speed_mps=speed_of(moment, motions, headings), ego_yaw_rate_radps=moment.ego_yaw_rate_radps,
    )  # fmt: skip
    return Found(row, features, after, notes, unusable)


def _is_worth_having(shown: Shown, usable: Collection[str], *, alone: bool) -> bool:
    """Whether an incomplete moment shows a scene that no other moment shows."""
    if len(set(shown.kinds.values())) == len(shown.kinds):
        return alone
    return bool(possible_edges([BASE, *(Sensor(s, cast("Kind", shown.kinds[s])) for s in usable)]))


def _less(captures: Mapping[str, Any], unusable: Mapping[str, FrameReason]) -> dict[str, Any]:
    return {s: c for s, c in captures.items() if s not in unusable}


def _is_skewed(capture: Any) -> bool:
    """Whether a sweep came as logged though its points have times."""
    return isinstance(capture, Sweep) and not capture.lidar_deskewed and capture.lidar_time_s is not None


def _deskewed(shown: Shown, lidar: str, sweep: Sweep, motions: Mapping[str, RadarMotion]) -> Sweep:
    """The sweep, moved by the first known radar velocity, if any."""
    if not _is_skewed(sweep):
        return sweep
    moved = (deskewed(sweep, motion, shown.heading(radar, lidar)) for radar, motion in motions.items())
    return next((found for found in moved if found is not sweep), sweep)


def _sources(rig: Rig, fleet: FleetConfig) -> tuple[Sources, dict[str, Any]]:
    """Sources of each sensor, and their part of the work key."""
    keys: dict[str, Any] = {}
    cameras: dict[str, SemanticsSource | None] = {}
    for name, camera in rig.cameras.items():
        if camera.semantics is None:
            cameras[name], keys[name] = None, {"source": "brightness"}
        else:
            cameras[name], keys[name] = _source(camera.semantics, fleet)
    lidars = {name: _points(lidar, fleet) for name, lidar in rig.lidars.items()}
    radars = {name: _drivable(radar, fleet) for name, radar in rig.radars.items()}
    keys |= {
        f"{s} turn": of.turn.model_dump(mode="json") for s, of in rig.lidars.items() if of.turn is not None
    }
    keys |= {name: model.provenance for name, model in (lidars | radars).items() if model is not None}
    readouts_s = {name: camera.readout_s for name, camera in rig.cameras.items() if camera.readout_s}
    keys |= {f"{name} readout_s": readout_s for name, readout_s in readouts_s.items()}
    return Sources(cameras, lidars, radars, fleet.perceive, fleet.ingest.deskew, readouts_s), keys


def _source(
    wanted: TopicSemantics | OnnxSemantics, fleet: FleetConfig
) -> tuple[SemanticsSource, dict[str, Any]]:
    """Source of semantics, and its part of the work key."""
    if isinstance(wanted, TopicSemantics):
        keyed = wanted.model_dump(mode="json", include={"source", "label_set", "classes"})
        return TopicSource(wanted, fleet.perceive), keyed
    # onnxruntime loads only where it is used.
    from pipeline.perceive.models.source import ModelSource  # noqa: PLC0415

    models = ModelSource(wanted, fleet)
    return models, {"source": "onnx", **models.provenance}


def _drivable(radar: RadarTopics, fleet: FleetConfig) -> DrivableSource | None:
    if radar.drivable is None:
        return None
    from pipeline.perceive.models.radar_drivable import RadarDrivable  # noqa: PLC0415 - as in _source

    return RadarDrivable(fleet.path_of(radar.drivable.model))


def _points(lidar: LidarTopics, fleet: FleetConfig) -> PointSource | None:
    if lidar.semantics is None:
        return None
    from pipeline.perceive.models.range_image import RangeImageSegmenter  # noqa: PLC0415 - as in _source

    return RangeImageSegmenter(fleet.path_of(lidar.semantics.segmenter), lidar.semantics.remission_scale)
