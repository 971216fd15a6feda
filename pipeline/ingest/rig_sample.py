"""A sample of a day's moments for a rig: fields of view, edges, facts for the verdict on each edge, a matrix."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
from jaxtyping import Float

from pipeline.core.rigs import OnnxSemantics
from pipeline.ingest.directions_and_units import AskedRadar, Motion, motion_of, opposed_signs
from pipeline.ingest.readiness import DofVerdict, Evidence, in_order, judge_edge
from pipeline.rig.cameras import camera_of
from pipeline.rig.graph import BASE, Edge, RigGraph, Sensor, possible_edges
from pipeline.rig.overlap import (
    FRAMES,
    Overlap,
    View,
    find_edges,
    overlaps_of,
    view_of_camera,
    view_of_clouds,
)
from pipeline.rig.prior import RigPrior, Star, between, middle_of
from pipeline.rig.rig import Rig
from pipeline.rig.scan_rows import rows_of
from pipeline.rig.se3 import to_spherical
from pipeline.store.views import frame_of, priors_of
from schemas.calibrations import SENSORS
from schemas.captures import Capture, Image, Scan, Sweep
from schemas.frames import Frame
from schemas.moments import Moment

__all__ = ["PairFinding", "RigFinding", "RigSample", "dof_counts", "rig_finding"]

_COUNTED: Final = ("roll", "pitch", "yaw", "x", "y", "z")


@dataclass(frozen=True)
class PairFinding:
    """One pair of sensors.

    Args:
        share: common share of the smaller field of view, at the prior; None if unknown, and for base.
        moments: number with both sensors; for base, number with the sensor.
    """

    parent: str
    child: str
    kind: str
    share: float | None
    moments: int
    is_edge: bool
    why_not: str = ""
    verdicts: list[DofVerdict] = field(default_factory=list)


@dataclass(frozen=True)
class RigFinding:
    """The rig: kinds by sensor, the reference of the poses, all possible edges, and unconnected sensors."""

    sensors: dict[str, str]
    reference: str
    pairs: list[PairFinding]
    loose: list[str]


@dataclass(frozen=True, eq=False)
class RigSample:
    """Sampled moments of a day.

    Args:
        built: usable moments of the sample, in order of time.
        looked: number of sampled moments, unusable ones included.
        present: for each moment of the day, the sensors that have a stamp.
        prior: of all sensors; None if there is none.
        missing: by sensor, the topics without usable messages and the reason.
        tracked: radars whose messages are tracks.
    """

    rig: Rig
    built: Sequence[tuple[Moment, Mapping[str, Capture]]]
    looked: int
    present: Sequence[frozenset[str]]
    stars: Mapping[str, Star]
    prior: RigPrior | None
    missing: Mapping[str, tuple[str, ...]]
    tracked: Collection[str] = ()
    _motions: dict[tuple[str, str], Motion] = field(default_factory=dict)

    @cached_property
    def overlaps(self) -> tuple[Overlap, ...]:
        """Overlaps of all sensors that have data and a prior."""
        return () if self.prior is None else overlaps_of(self.prior, self._views())

    @cached_property
    def graph(self) -> RigGraph:
        """The rig's edges, from the fields of view in the sample."""
        nodes = {node.name: node for node in self.rig.nodes}
        reference = None if self.rig.reference is None else nodes[self.rig.reference]
        prior = self.prior or RigPrior(self.rig.nodes, middle_of(self.rig.nodes), {}, {})
        return find_edges(prior, self.overlaps, named=self.rig.named_edges, reference=reference)

    @cached_property
    def evidence(self) -> dict[Edge, Evidence]:
        """Facts for the verdict on each edge."""
        edges = sorted(self.graph.edges, key=lambda edge: in_order(edge.kind))
        return {edge: self._evidence(edge) for edge in edges}

    @cached_property
    def verdicts(self) -> dict[Edge, list[DofVerdict]]:
        """Verdicts of every edge."""
        return {edge: judge_edge(self.name(edge), edge.kind, of) for edge, of in self.evidence.items()}

    @property
    def whole(self) -> Evidence:
        """Facts for the whole rig: on sensors from its first edge, on moments from all edges."""
        if not self.evidence:
            return Evidence(self._usable(len(self.built)), False, 0.0, 0.0, False, 0, 0.0, None)
        return replace(
            next(iter(self.evidence.values())),
            frames=self._usable(len(self.built)),
            has_prior=all(e.has_prior for e in self.evidence.values()),
            missing=tuple(why for own in self.missing.values() for why in own),
        )

    def name(self, edge: Edge) -> str:
        """Name of an edge: its kind if the sensors are named after their kinds, else the sensors' names."""
        return edge.kind if all(node.name == node.kind for node in self.rig.nodes) else edge.name

    @property
    def finding(self) -> RigFinding:
        """The rig as a matrix."""
        return rig_finding(self.graph, self.overlaps, self.present, self.verdicts)

    def _evidence(self, edge: Edge) -> Evidence:
        """Facts on an edge's two sensors, and on one more sensor of each other kind."""
        chosen, ends = self._beside(edge), {s.name for s in edge.sensors if s.kind != "base"}
        own = [m for m, captures in self.built if ends <= captures.keys()]
        tied = [
            between(self.stars.get(m.log, {}), edge.parent.name, edge.child.name) is not None for m in own
        ]
        motion, frames = self.motion(chosen), self.frames(chosen)
        semantics = self.rig.cameras[chosen["camera"]].semantics if "camera" in chosen else None
        # Without a camera, or one that is silent, no labels are lacking, but there are no boxes either.
        computed = isinstance(semantics, OnnxSemantics)
        seen, swept, scanned = ([f for f in frames if kind in f.sensors] for kind in SENSORS)
        labelled = _share([f.labels_png is not None for f in seen])
        return Evidence(
            frames=self._usable(len(own)),
            has_prior=2 * sum(tied) > len(tied),
            labels_share=1.0 if not seen or computed else labelled,
            detections_share=1.0 if computed else _share([f.detection_boxes_px is not None for f in seen]),
            has_intensity=_share([f.lidar_intensity is not None for f in swept]) > 0.5,
            rings=self._rings.get(chosen.get("lidar", ""), 0),
            elevation_share=_share([f.radar_has_elevation for f in scanned]),
            moving_share=motion.moving_share,
            doppler_problem=motion.doppler_problem,
            doppler_is_wrong=motion.doppler_is_wrong,
            wrong=motion.wrong,
            missing=tuple(why for name in self.missing if name in ends for why in self.missing[name]),
            has_odometry=any(f.ego_speed_mps is not None for f in frames),
            names_semantics=not seen or semantics is not None,
        )

    def frames(self, chosen: Mapping[str, str]) -> list[Frame]:
        """Moments as frames of some of the sensors, given by kind."""
        priors = {log: priors_of(star, chosen) for log, star in self.stars.items()}
        return [
            frame_of(m, {k: captures[s] for k, s in chosen.items() if s in captures}, priors.get(m.log, {}))
            for m, captures in self.built
        ]

    def motion(self, chosen: Mapping[str, str]) -> Motion:
        """Motion of the car from the chosen lidar and radar, computed once."""
        shown = (chosen.get("lidar", ""), chosen.get("radar", ""))
        if shown not in self._motions:
            radar = self.asked(shown[1]) if shown[1] else None
            self._motions[shown] = motion_of(self.frames(chosen), radar)
        return self._motions[shown]

    def asked(self, radar: str) -> AskedRadar:
        """A radar with the direction in which it looks: by the vehicle frame, else by a lidar, whose x points ahead."""
        ahead = {}
        for log, star in self.stars.items():
            known = (between(star, frame, radar) for frame in (BASE.name, *self.rig.lidars))
            T = next((T for T in known if T is not None), None)
            if T is not None:
                ahead[log] = T[:3, :3]
        return AskedRadar(radar, self.rig.radars[radar], ahead, radar not in self.tracked)

    @cached_property
    def _rings(self) -> dict[str, int]:
        """Number of rows of each lidar in the log; 0 if its rings are lasers of a scan pattern without rows."""
        found = dict.fromkeys(self.rig.lidars, 0)
        for name in found:
            sweeps = [captures[name] for _, captures in self.built if name in captures]
            found[name] = max((_rows(s) for s in sweeps if isinstance(s, Sweep)), default=0)
        return found

    @property
    def advice(self) -> list[str]:
        """Advice from each radar's Doppler, computed once."""
        edges = [edge for edge in self.graph.edges if "radar" in edge.kind]
        motions = {c["radar"]: self.motion(c) for c in map(self._beside, edges)}
        found = [a for motion in motions.values() for a in motion.advice]
        return [*found, *opposed_signs({name: m.doppler_positive for name, m in motions.items()})]

    def _usable(self, looked_into: int) -> int:
        """Number of usable moments of the day, extrapolated from the sample."""
        return round(len(self.present) * looked_into / max(self.looked, 1))

    def _beside(self, edge: Edge) -> dict[str, str]:
        """The edge's sensors by kind, and for each missing kind the sensor with the largest overlap."""
        chosen: dict[str, str] = {s.kind: s.name for s in edge.sensors if s.kind != "base"}
        for node in self.rig.nodes:
            if node.kind not in ("base", *chosen):
                others = [n for n in self.rig.nodes if n.kind == node.kind]
                chosen[node.kind] = max(others, key=lambda n: self._shared(n, edge)).name
        return chosen

    def _shared(self, sensor: Sensor, edge: Edge) -> float:
        ends = {frozenset((sensor, end)) for end in edge.sensors}
        return sum((o.shared_sr for o in self.overlaps if frozenset(o.edge.sensors) in ends), 0.0)

    def _views(self) -> dict[str, View]:
        views: dict[str, View | None] = {}
        for node in self.rig.nodes:
            own = [captures[node.name] for _, captures in self.built if node.name in captures]
            cameras = [c for c in own if isinstance(c, Image)]
            clouds = [_points(c) for c in own[:: max(len(own) // FRAMES, 1)] if isinstance(c, Sweep | Scan)]
            views[node.name] = view_of_camera(camera_of(cameras[0])) if cameras else view_of_clouds(clouds)
        return {name: view for name, view in views.items() if view is not None}


def _points(capture: Sweep | Scan) -> Float[np.ndarray, "N 3"]:
    xyz = capture.lidar_xyz_m if isinstance(capture, Sweep) else capture.radar_xyz_m
    return xyz[np.isfinite(xyz).all(axis=1)]


def _share(flags: list[bool]) -> float:
    return float(np.mean(flags)) if flags else 0.0


def _rows(sweep: Sweep) -> int:
    if sweep.lidar_ring is None:
        return 0
    xyz = sweep.lidar_xyz_m.astype(np.float64)
    finite = np.isfinite(xyz).all(axis=1)
    rows = rows_of(to_spherical(xyz[finite]), sweep.lidar_ring[finite])
    return 0 if rows is None else int(rows.row.max()) + 1


def rig_finding(
    graph: RigGraph,
    overlaps: Sequence[Overlap],
    moments: Sequence[Collection[str]],
    verdicts: Mapping[Edge, list[DofVerdict]],
) -> RigFinding:
    """Matrix of a rig: `moments` has the sensors with data of each moment."""
    seen = {o.edge: o for o in overlaps}
    pairs = []
    for edge in possible_edges(graph.sensors):
        is_edge, share = edge in graph.edges, seen[edge].share if edge in seen else None
        ends = {s.name for s in edge.sensors if s.kind != "base"}
        both = sum(ends <= set(moment) for moment in moments)
        why_not = "" if is_edge else _why_not(edge, seen.get(edge), moments)
        own = list(verdicts.get(edge, ()))
        pairs.append(
            PairFinding(edge.parent.name, edge.child.name, edge.kind, share, both, is_edge, why_not, own)
        )
    tied = graph.components()[0]
    loose = [s.name for s in graph.sensors if s not in tied]
    return RigFinding({s.name: s.kind for s in graph.sensors}, graph.reference.name, pairs, loose)


def dof_counts(verdicts: Sequence[DofVerdict]) -> tuple[int, int]:
    """Number of DoF of the six that an edge gives, and number that depend partly on the prior."""
    counts = dict.fromkeys(("yes", "weak", "no"), 0)
    for verdict in verdicts:
        words = verdict.dof.replace("translation", "x y z").replace(",", " ").split()
        counts[verdict.verdict] += sum(word in _COUNTED for word in words)
    return counts["yes"], counts["weak"]


def _why_not(edge: Edge, overlap: Overlap | None, moments: Sequence[Collection[str]]) -> str:
    silent = [s.name for s in edge.sensors if s.kind != "base" and not any(s.name in m for m in moments)]
    if silent:
        return f"no data of {' and '.join(silent)}"
    if overlap is None:
        return "no prior" if edge.child.kind != "base" else "not named"
    return "others share more" if overlap.is_enough else "their fields of view do not overlap"
