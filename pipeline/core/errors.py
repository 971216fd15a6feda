"""Errors that a user can act on. Each error has fields, and builds its message from them."""

from __future__ import annotations

from typing import Any

__all__ = [
    "BoresightError", "CollectedError", "ConfigError", "ContractError", "DamagedError", "DamagedLogError",
    "DownloadError", "LogError", "MissingExtraError", "MissingLibraryError", "ModelError", "ModelOutputError",
    "SolveError", "StorageError", "TooMuchMemoryError",
]  # fmt: skip


class BoresightError(Exception):
    """Base of all errors that the commands report in one line; `exit_code` is what the command returns."""

    exit_code = 1

    def __reduce__(self) -> Any:
        # Errors cross process boundaries; by default, unpickling would call the class with the message only.
        return _revived, (type(self), self.args, self.__dict__)


def _revived(kind: type[BoresightError], args: tuple[Any, ...], fields: dict[str, Any]) -> BoresightError:
    error = kind.__new__(kind, *args)
    error.__dict__.update(fields)
    return error


class ConfigError(BoresightError):
    """Wrong entry in fleet.toml, a manifest or a command line. Has file, key, and problem with remedy."""

    exit_code = 2

    def __init__(self, file: str, key: str, problem: str) -> None:
        self.file, self.key, self.problem = file, key, problem
        super().__init__(f"{file}: {key}: {problem}" if key else f"{file}: {problem}")


class LogError(BoresightError):
    """A log, topic or field that cannot be read."""

    def __init__(self, file: str, problem: str, *, topic: str = "", field: str = "") -> None:
        self.file, self.topic, self.field, self.problem = file, topic, field, problem
        where = ", ".join(p for p in (file, topic and f"topic {topic}", field and f"field {field}") if p)
        super().__init__(f"{where}: {problem}")


class _PlacedError(BoresightError):
    """An error at one place: a file, folder or address."""

    def __init__(self, path: str, problem: str) -> None:
        self.path, self.problem = path, problem
        super().__init__(f"{path}: {problem}")


class ContractError(_PlacedError):
    """A table without the schema, version or content that its contract requires."""


class OtherVersionError(ContractError):
    """A table whose schema is of another version than this release reads, and the release that wrote it."""

    def __init__(self, path: str, found: str, release: str, reads: str, remedy: str) -> None:
        told = f"holds {found}, written by boresight {release}; this version reads {reads}"
        super().__init__(path, f"{told}: {remedy}")


class DamagedError(ContractError):
    """A file of a table that cannot be read; with the file moved away, its stage makes it again."""

    def __init__(self, path: str, problem: str) -> None:
        super().__init__(path, f"is damaged: run its stage again ({problem})")


class DamagedLogError(ContractError):
    """A record table with an unreadable log; `boresight repair` writes a new log for its data files."""

    def __init__(self, path: str, problem: str, lake: str) -> None:
        super().__init__(path, f"its log is damaged ({problem}): run `boresight repair --lake {lake}`")


class CollectedError(DamagedError):
    """A partition whose rows were deleted at the end of their retention. Ingest makes them again."""

    def __init__(self, path: str, day: str) -> None:
        ContractError.__init__(self, path, f"its rows were deleted on {day}: ingest the day's logs again")


class MissingExtraError(BoresightError):
    """A command needs `module`, which only `pip install boresight[extra]` installs."""

    exit_code = 2

    def __init__(self, extra: str, module: str) -> None:
        self.extra, self.module = extra, module
        super().__init__(
            f"needs {module}, which comes with the extra [{extra}]: pip install 'boresight[{extra}]'"
        )


class DownloadError(_PlacedError):
    """A download that failed; no file was written."""


class MissingLibraryError(BoresightError):
    """`needed_by` needs `missing` of the system, which pip does not install; `packages` of Debian bring it."""

    exit_code = 2

    def __init__(self, needed_by: str, missing: str, packages: str, instead: str = "") -> None:
        self.needed_by, self.missing, self.packages, self.instead = needed_by, missing, packages, instead
        command = f"apt-get install {packages} (Debian, Ubuntu)" if packages else ""
        what = command or instead or "install the package that holds it"
        super().__init__(f"{needed_by} needs {missing}, which this machine lacks: {what}")


class ModelError(_PlacedError):
    """A model file that does not match its manifest."""

    exit_code = 2


class ModelOutputError(ModelError):
    """Impossible output values of a model; the day is refused."""


class StorageError(_PlacedError):
    """An object store that does not answer after several tries; nothing is damaged, so try again later."""


class TooMuchMemoryError(BoresightError):
    """Work on a vehicle-day that needed more memory than the limit of a worker; the day is refused."""

    faults = ("memory",)

    def __init__(self, gigabytes: float) -> None:
        self.gigabytes = gigabytes
        super().__init__(
            f"needed more than {gigabytes:g} GB of memory (fleet.memory_gb): look for a damaged log, or raise the limit"
        )


class SolveError(BoresightError):
    """A vehicle-day that cannot be calibrated; it becomes a refused record, not a crash."""

    exit_code = 3

    def __init__(self, reason: str, fault: str = "") -> None:
        self.reason, self.fault = reason, fault  # key of schemas.faults.FAULTS, empty if unknown
        super().__init__(reason)
