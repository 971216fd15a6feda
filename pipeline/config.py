"""fleet.toml as frozen values: validated as a whole, nothing repaired, defaults are physical numbers with units."""

from __future__ import annotations

import difflib
import hashlib
import json
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import (
    BaseModel,
    Field,
    PrivateAttr,
    ValidationError,
    model_validator,
)

from pipeline.errors import ConfigError
from pipeline.names import is_pattern, is_vehicle, matches
from pipeline.rig.rig import SECTIONS, Rig
from pipeline.rigs import Positive, Section
from pipeline.sections import (
    TERMS,
    AuditConfig,
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
from pipeline.shipped_models import PREFIX, shipped_manifest

__all__ = [
    "TERMS",
    "AuditConfig",
    "FleetConfig",
    "IngestConfig",
    "LearnConfig",
    "PerceiveConfig",
    "PrepareConfig",
    "ReportConfig",
    "SelectConfig",
    "SolveConfig",
    "TriggerConfig",
    "VerifyConfig",
    "config_hash",
    "load_fleet",
    "read_toml",
    "validated",
]

_Kind = TypeVar("_Kind", bound=BaseModel)
_SHORT = {(section, kind) for kind, section in SECTIONS.items()}


class Vehicle(Section):
    """One vehicle."""

    rig: str = "default"


class FleetSection(Section):
    """The fleet's name, and what its workers may take of the machine."""

    name: str
    # Of one stage of one vehicle-day, beside what the worker has. Ordinary days take 1.3, 1 of it reserved and unused.
    memory_gb: Positive = 4.0


class FleetConfig(Section):
    """The whole of fleet.toml, and which file it was read from: paths in it are relative to that file."""

    fleet: FleetSection
    rigs: dict[str, Rig]
    # By name, or by a pattern with * and ? for whichever vehicles the logs are of.
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
    _file: Path = PrivateAttr(default=Path("fleet.toml"))  # no value of the file: never dumped, never hashed

    @model_validator(mode="after")
    def _vehicles_name_known_rigs(self) -> FleetConfig:
        for name, vehicle in self.vehicles.items():
            if not is_vehicle(name):
                raise ValueError(
                    f"{name!r} cannot be a vehicle's name: it names folders, so no / or =, and not as long"
                )
            if vehicle.rig not in self.rigs:
                raise ValueError(
                    f"vehicles.{name}.rig = {vehicle.rig!r}, but rigs has only {sorted(self.rigs)}"
                )
        return self

    @property
    def file(self) -> Path:
        """The file that this was read from; "fleet.toml" of the working folder where it came from no file."""
        return self._file

    def require_files(self) -> None:
        """Raise ConfigError, naming the key, for the first file that the vehicles' rigs or [learn] name and is missing.

        For commands that read logs: before the first one is opened, not after a night.
        """
        for key, name in self._named_files():
            if not self.path_of(name).is_file():
                raise ConfigError(str(self._file), key, f"no such file: {self.path_of(name)}")

    def _named_files(self) -> Iterator[tuple[str, str]]:
        for name in sorted({v.rig for v in self.vehicles.values()}):
            rig, key = self.rigs[name], f"rigs.{name}"
            yield from ((f"{key}.{of}", file) for of, file in rig.named_models())
            if rig.prior.file is not None:
                yield f"{key}.prior.file", rig.prior.file
        if self.learn.model is not None:
            yield "learn.model", self.learn.model
        for pair, model in self.learn.pairwise_models.items():
            yield f"learn.pairwise_models.{pair}", model

    def path_of(self, name: str) -> Path:
        """A path that the file names: relative to the file's folder unless absolute, or a network that ships."""
        return shipped_manifest(name) if name.startswith(PREFIX) else self._file.parent / name

    def read_from(self, file: Path) -> FleetConfig:
        """The same configuration as if it had been read from another file."""
        copy = self.model_copy()
        copy._file = file  # noqa: SLF001 - a copy of this very class
        return copy

    def changed(self, **sections: dict[str, Any]) -> FleetConfig:
        """With other values in some sections, validated like those of a file; the file stays.

        Args:
            sections: as `select={"frames": 16}`; keys that are not named keep their value.

        Raises:
            ConfigError: no such section or key, or an impossible value; the message names the key.
        """
        new: dict[str, Any] = {}
        for name, values in sections.items():
            section = getattr(self, name, None)
            if not isinstance(section, Section):
                raise ConfigError(str(self._file), name, "no such section")
            # Not through a dump: it would leave out what is no part of a work key (`exclude`).
            kept = {key: getattr(section, key) for key in type(section).model_fields}
            new[name] = validated(type(section), kept | values, str(self._file), name)
        return self.model_copy(update=new)

    @property
    def named_vehicles(self) -> tuple[str, ...]:
        """Vehicles that the file names; those of its patterns are known by their logs."""
        return tuple(name for name in self.vehicles if not is_pattern(name))

    def knows(self, vehicle: str) -> bool:
        """Whether the file names the vehicle, or has a pattern for it."""
        return bool(self._entries_for(vehicle))

    def vehicle(self, vehicle: str) -> Vehicle:
        """What the file says of a vehicle: by its name, else by the longest pattern that it matches.

        Raises:
            ConfigError: nothing.
        """
        entries = self._entries_for(vehicle)
        if not entries:
            problem = f"unknown vehicle; the file has {sorted(self.vehicles)}"
            raise ConfigError(str(self._file), f"vehicles.{vehicle}", problem)
        return self.vehicles[vehicle if vehicle in entries else max(entries, key=lambda e: (len(e), e))]

    def _entries_for(self, vehicle: str) -> list[str]:
        """Keys of [vehicles] that are the vehicle's name or a pattern of it."""
        return [e for e in self.vehicles if e == vehicle or (is_pattern(e) and matches(e, vehicle))]

    def rig_of(self, vehicle: str) -> Rig:
        """The rig of a vehicle; ConfigError where the file does not know the vehicle."""
        return self.rigs[self.vehicle(vehicle).rig]

    def with_prior_file(self, vehicle: str, file: Path) -> FleetConfig:
        """The same configuration, with the prior of a vehicle's rig from a file, as far to be trusted as before."""
        rig = self.rig_of(vehicle)
        prior = rig.prior.model_copy(update={"source": "file", "file": str(file.resolve())})
        return self.with_rig(vehicle, rig.model_copy(update={"prior": prior}))

    def with_rig(self, vehicle: str, rig: Rig) -> FleetConfig:
        """The same configuration, with another rig in place of a vehicle's."""
        return self.model_copy(update={"rigs": self.rigs | {self.vehicle(vehicle).rig: rig}})


def load_fleet(path: Path) -> FleetConfig:
    """Read and validate fleet.toml.

    Raises:
        ConfigError: missing file, no TOML, unknown key, impossible value; the message names the key.
    """
    return validated(FleetConfig, read_toml(path), str(path)).read_from(path)


def read_toml(path: Path) -> dict[str, Any]:
    """What a TOML file says.

    Raises:
        ConfigError: missing file, no TOML.
    """
    try:
        return tomllib.loads(path.read_text())
    except FileNotFoundError as err:
        raise ConfigError(str(path), "", "no such file") from err
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, IsADirectoryError) as err:
        raise ConfigError(str(path), "", f"not a TOML file: {err}") from err


def validated(kind: type[_Kind], values: dict[str, Any], file: str, *above: str) -> _Kind:
    """A section of a file; `above` names the sections that it lies in.

    Raises:
        ConfigError: unknown key, impossible value; the message names the key.
    """
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
    """A key as the file has it: a sensor of the short form is `camera`, and `cameras.camera` in the model."""
    for i, key in enumerate(loc):
        if not isinstance(values, dict):
            break
        if key not in values and tuple(loc[i : i + 2]) in _SHORT:
            return (*loc[:i], *loc[i + 1 :])
        values = values.get(key)
    return loc


def _unknown_key(key: str | int, whole: type[BaseModel]) -> str:
    """What to say of a key that no section of the whole has: the nearest one that some section has."""
    known = {name for kind in _kinds(whole, set()) for name in kind.model_fields}
    near = difflib.get_close_matches(str(key), known, n=1)
    return f"unknown key; did you mean {near[0]!r}?" if near else "unknown key"


def _kinds(annotation: Any, seen: set[type[BaseModel]]) -> set[type[BaseModel]]:
    """All sections that an annotation reaches."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        if annotation not in seen:
            seen.add(annotation)
            for field in annotation.model_fields.values():
                _kinds(field.annotation, seen)
    else:
        for part in get_args(annotation):
            _kinds(part, seen)
    return seen


def config_hash(*sections: BaseModel | dict[str, Any]) -> str:
    """Hash of resolved config sections, for work keys."""
    plain = [s.model_dump(mode="json") if isinstance(s, BaseModel) else s for s in sections]
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]
