"""fleet.toml as frozen values: validated as a whole, never repaired, with physical defaults."""

from __future__ import annotations

import difflib
import hashlib
import json
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, Field, PrivateAttr, ValidationError, model_validator

from pipeline.core.errors import ConfigError
from pipeline.core.models import PREFIX, shipped_manifest
from pipeline.core.names import is_pattern, is_vehicle, matches
from pipeline.core.rigs import Positive, Section
from pipeline.core.sections import (
    TERMS,
    AuditConfig,
    ChecksConfig,
    IngestConfig,
    LearnConfig,
    PerceiveConfig,
    PrepareConfig,
    ReportConfig,
    SelectConfig,
    SolveConfig,
    TriggerConfig,
    VerifyConfig,
)
from pipeline.rig.rig import SECTIONS, Rig

__all__ = [
    "TERMS", "AuditConfig", "ChecksConfig", "FleetConfig", "IngestConfig", "LearnConfig", "PerceiveConfig",
    "PrepareConfig", "ReportConfig", "SelectConfig", "SolveConfig", "TriggerConfig", "VerifyConfig",
    "config_hash", "load_fleet", "read_toml", "validated",
]  # fmt: skip

_Kind = TypeVar("_Kind", bound=BaseModel)
_SHORT = {(section, kind) for kind, section in SECTIONS.items()}


class Vehicle(Section):
    """One vehicle: the name of its rig, and of its model if it is not the rig's."""

    rig: str = "default"
    model: str | None = None

    @property
    def model_or_rig(self) -> str:
        """Name of the model, whose vehicles are taken to be built alike."""
        return self.model or self.rig


class FleetSection(Section):
    """Name of the fleet, and the limits of its workers on one machine."""

    name: str
    # Memory [GB] that one stage of one vehicle-day may use in addition to the idle worker. Ordinary days use
    # 1.3, of which 1 is reserved and never touched.
    memory_gb: Positive = 4.0


class FleetConfig(Section):
    """All of fleet.toml, and the path of the file it was read from: paths in the file are relative to it."""

    fleet: FleetSection
    rigs: dict[str, Rig]
    # By name, or by a pattern with * and ? that matches the names of vehicles in the logs.
    vehicles: dict[str, Vehicle] = Field(default_factory=dict)
    ingest: IngestConfig = IngestConfig()
    perceive: PerceiveConfig = PerceiveConfig()
    select: SelectConfig = SelectConfig()
    trigger: TriggerConfig = TriggerConfig()
    solve: SolveConfig = SolveConfig()
    verify: VerifyConfig = VerifyConfig()
    prepare: PrepareConfig = PrepareConfig()
    learn: LearnConfig = LearnConfig()
    audit: AuditConfig = AuditConfig()
    report: ReportConfig = ReportConfig()
    _file: Path = PrivateAttr(default=Path("fleet.toml"))  # not a key of the file: neither dumped nor hashed

    @model_validator(mode="after")
    def _vehicles_name_known_rigs(self) -> FleetConfig:
        for name, vehicle in self.vehicles.items():
            if not is_vehicle(name):
                raise ValueError(
                    f"{name!r} cannot be a vehicle's name: use a shorter one without / and =, as for a folder"
                )
            if vehicle.rig not in self.rigs:
                raise ValueError(
                    f"vehicles.{name}.rig = {vehicle.rig!r}, but rigs has only {sorted(self.rigs)}"
                )
        rig_of: dict[str, str] = {}
        for name, vehicle in self.vehicles.items():
            if rig_of.setdefault(vehicle.model_or_rig, vehicle.rig) != vehicle.rig:
                raise ValueError(
                    f"vehicles.{name}: model {vehicle.model_or_rig!r} has the rig {vehicle.rig!r} here and "
                    f"{rig_of[vehicle.model_or_rig]!r} elsewhere; vehicles of one model have one rig"
                )
        return self

    @property
    def file(self) -> Path:
        """Path of fleet.toml; "fleet.toml" of the working folder if the values came from no file."""
        return self._file

    def require_files(self) -> None:
        """Raise ConfigError for a missing file of the vehicles' rigs or [learn], before a log is opened."""
        named = {f"learn.pairwise_models.{pair}": model for pair, model in self.learn.pairwise_models.items()}
        named |= {} if self.learn.model is None else {"learn.model": self.learn.model}
        for name in sorted({v.rig for v in self.vehicles.values()}):
            rig = self.rigs[name]
            named |= {f"rigs.{name}.{of}": file for of, file in rig.named_models()}
            named |= {} if rig.prior.file is None else {f"rigs.{name}.prior.file": rig.prior.file}
        for key, file in named.items():
            if not self.path_of(file).is_file():
                raise ConfigError(str(self._file), key, f"no such file: {self.path_of(file)}")

    def path_of(self, name: str) -> Path:
        """Path of a file named in fleet.toml (relative to its folder), or of a network of the package."""
        return shipped_manifest(name) if name.startswith(PREFIX) else self._file.parent / name

    def read_from(self, file: Path) -> FleetConfig:
        """Copy of this configuration with another file path."""
        copy = self.model_copy()
        copy._file = file  # noqa: SLF001 - a copy of this very class
        return copy

    def changed(self, **sections: dict[str, Any]) -> FleetConfig:
        """Copy with other values in some sections, as `select={"frames": 16}`, validated as on loading."""
        new: dict[str, Any] = {}
        for name, values in sections.items():
            section = getattr(self, name, None)
            if not isinstance(section, Section):
                raise ConfigError(str(self._file), name, "no such section")
            # Not through a dump, which leaves out fields that are not part of a work key (`exclude`).
            kept = {key: getattr(section, key) for key in type(section).model_fields}
            new[name] = validated(type(section), kept | values, str(self._file), name)
        return self.model_copy(update=new)

    @property
    def named_vehicles(self) -> tuple[str, ...]:
        """Vehicles named in the file; vehicles that match a pattern are found in their logs."""
        return tuple(name for name in self.vehicles if not is_pattern(name))

    def knows(self, vehicle: str) -> bool:
        """Whether the file has an entry or a pattern for the vehicle."""
        return bool(self._entries_for(vehicle))

    def vehicle(self, vehicle: str) -> Vehicle:
        """Entry of a vehicle in [vehicles]: its name, else the longest matching pattern; else ConfigError."""
        entries = self._entries_for(vehicle)
        if not entries:
            problem = f"unknown vehicle; the file has {sorted(self.vehicles)}"
            raise ConfigError(str(self._file), f"vehicles.{vehicle}", problem)
        return self.vehicles[vehicle if vehicle in entries else max(entries, key=lambda e: (len(e), e))]

    def _entries_for(self, vehicle: str) -> list[str]:
        """Keys of [vehicles] that equal the vehicle's name, or are patterns that match it."""
        return [e for e in self.vehicles if e == vehicle or (is_pattern(e) and matches(e, vehicle))]

    def rig_of(self, vehicle: str) -> Rig:
        """Rig of a vehicle; raises ConfigError for an unknown vehicle."""
        return self.rigs[self.vehicle(vehicle).rig]

    def with_prior_file(self, vehicle: str, file: Path) -> FleetConfig:
        """Copy in which the prior of a vehicle's rig comes from a file; its sigmas stay."""
        rig = self.rig_of(vehicle)
        prior = rig.prior.model_copy(update={"source": "file", "file": str(file.resolve())})
        return self.with_rig(vehicle, rig.model_copy(update={"prior": prior}))

    def with_rig(self, vehicle: str, rig: Rig) -> FleetConfig:
        """Copy in which a vehicle's rig is replaced."""
        return self.model_copy(update={"rigs": self.rigs | {self.vehicle(vehicle).rig: rig}})


def load_fleet(path: Path) -> FleetConfig:
    """Read and validate fleet.toml; a ConfigError names the key."""
    return validated(FleetConfig, read_toml(path), str(path)).read_from(path)


def read_toml(path: Path) -> dict[str, Any]:
    """Content of a TOML file; raises ConfigError if it is missing, or not TOML."""
    try:
        return tomllib.loads(path.read_text())
    except FileNotFoundError as err:
        raise ConfigError(str(path), "", "no such file (`boresight init` writes a fleet.toml)") from err
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, IsADirectoryError) as err:
        raise ConfigError(str(path), "", f"not a TOML file: {err}") from err


def validated(kind: type[_Kind], values: dict[str, Any], file: str, *above: str) -> _Kind:
    """Section of a file, validated; `above` names the sections around it; a ConfigError names the key."""
    whole = FleetConfig if above else kind
    try:
        return kind.model_validate(values)
    except ValidationError as err:
        problems = [
            (
                ".".join(map(str, (*above, *_written(p["loc"], values)))),
                _unknown_key(p["loc"][-1], whole)
                if p["type"] == "extra_forbidden"
                else p["msg"].removeprefix("Value error, "),
            )
            for p in err.errors(include_url=False)
        ]
        (key, first), *others = problems
        text = "; ".join([first, *(f"{other}: {said}" for other, said in others)])
        raise ConfigError(file, key, text) from err


def _written(loc: Sequence[str | int], values: Any) -> Sequence[str | int]:
    """Key as written in the file: the model has `cameras.camera` for a sensor of the short form, `camera`."""
    for i, key in enumerate(loc):
        if not isinstance(values, dict):
            break
        two: Any = tuple(loc[i : i + 2])
        if key not in values and two in _SHORT:
            return (*loc[:i], *loc[i + 1 :])
        values = values.get(key)
    return loc


def _unknown_key(key: str | int, whole: type[BaseModel]) -> str:
    """Message for an unknown key; it suggests the most similar known key."""
    schema = whole.model_json_schema()
    sections = (schema, *schema.get("$defs", {}).values())
    known = {name for section in sections for name in section.get("properties", ())}
    near = difflib.get_close_matches(str(key), known, n=1)
    return f"unknown key; did you mean {near[0]!r}?" if near else "unknown key"


def config_hash(*sections: BaseModel | dict[str, Any]) -> str:
    """Hash of resolved config sections, for work keys."""
    plain = [s.model_dump(mode="json") if isinstance(s, BaseModel) else s for s in sections]
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]
