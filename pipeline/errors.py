"""Errors that a user can act on. Fields, not strings: each error builds its message from what it knows."""

from __future__ import annotations

from typing import Any

__all__ = [
    "BoresightError",
    "CollectedError",
    "ConfigError",
    "ContractError",
    "DamagedError",
    "DamagedLogError",
    "DownloadError",
    "LogError",
    "MissingExtraError",
    "ModelError",
    "ModelOutputError",
    "SolveError",
    "StorageError",
    "TooMuchMemoryError",
]


class BoresightError(Exception):
    """Base of all errors that the commands report in one line; `exit_code` is what the command returns."""

    exit_code = 1

    def __reduce__(self) -> Any:
        # Errors come home from other processes; by default Python would build them from their message alone.
        return _revived, (type(self), self.args, self.__dict__)


def _revived(kind: type[BoresightError], args: tuple[Any, ...], fields: dict[str, Any]) -> BoresightError:
    error = kind.__new__(kind, *args)
    error.__dict__.update(fields)
    return error


class ConfigError(BoresightError):
    """fleet.toml, a manifest or a command line that cannot be right: `file`, `key`, what is wrong and what to do."""

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


class ContractError(BoresightError):
    """A table that does not have the schema, version or content that its contract promises."""

    def __init__(self, path: str, problem: str) -> None:
        self.path, self.problem = path, problem
        super().__init__(f"{path}: {problem}")


class DamagedError(ContractError):
    """A file of a table that cannot be read; out of the way, it is made anew from what it was made of."""

    def __init__(self, path: str, problem: str) -> None:
        super().__init__(path, f"is damaged, make it anew: {problem}")


class DamagedLogError(ContractError):
    """A record table whose log cannot be read; what its data files hold, `boresight repair` puts under a new one."""

    def __init__(self, path: str, problem: str, lake: str) -> None:
        super().__init__(path, f"its log is damaged ({problem}): run `boresight repair --lake {lake}`")


class CollectedError(DamagedError):
    """A partition whose rows left the lake after their time; out of the way, they are made anew from the logs."""

    def __init__(self, path: str, day: str) -> None:
        ContractError.__init__(self, path, f"its rows left the lake on {day}: ingest the day's logs again")


class MissingExtraError(BoresightError):
    """A command needs `module`, which a plain `pip install boresight` leaves out: `extra` brings it."""

    exit_code = 2

    def __init__(self, extra: str, module: str) -> None:
        self.extra, self.module = extra, module
        super().__init__(
            f"needs {module}, which comes with the extra [{extra}]: pip install 'boresight[{extra}]'"
        )


class DownloadError(BoresightError):
    """A file that the web did not give; nothing was placed."""

    def __init__(self, url: str, problem: str) -> None:
        self.url, self.problem = url, problem
        super().__init__(f"{url}: {problem}")


class ModelError(BoresightError):
    """A model file that does not do what its manifest says."""

    exit_code = 2

    def __init__(self, manifest: str, problem: str) -> None:
        self.manifest, self.problem = manifest, problem
        super().__init__(f"{manifest}: {problem}")


class ModelOutputError(ModelError):
    """Values of a model that cannot be right, whatever it was shown: the day is refused."""


class StorageError(BoresightError):
    """An object store that does not answer, also after retries: nothing is damaged, and another try may help."""

    def __init__(self, place: str, problem: str) -> None:
        self.place, self.problem = place, problem
        super().__init__(f"{place}: {problem}")


class TooMuchMemoryError(BoresightError):
    """Work on a vehicle-day that asked for more memory than a worker may take; the day is refused."""

    faults = ("memory",)

    def __init__(self, gigabytes: float) -> None:
        self.gigabytes = gigabytes
        super().__init__(
            f"needed more than {gigabytes:g} GB of memory (fleet.memory_gb): look for a damaged log, or raise it"
        )


class SolveError(BoresightError):
    """A vehicle-day that cannot be calibrated; it becomes a refused record, not a crash."""

    exit_code = 3

    def __init__(self, reason: str, fault: str = "") -> None:
        self.reason, self.fault = reason, fault  # a key of schemas.faults.FAULTS, where one is known
        super().__init__(reason)
