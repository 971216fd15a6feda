"""Simulated logs, made once: a copy for whoever asks again, until a source that makes them changes."""

import ast
import hashlib
import shutil
import sys
import tempfile
import time
from contextlib import suppress
from functools import cache
from importlib.metadata import distributions
from pathlib import Path

from pipeline.simulate.fleet import FleetSpec, simulate_fleet

__all__ = ["kept_fleet", "sources_of"]

REPO = Path(__file__).resolve().parents[2]
KEPT = REPO / ".pytest_cache" / "simulated_days"
FORGOTTEN_AFTER_S = 7 * 86_400.0  # days of older sources; another run may still read younger ones


def kept_fleet(spec: FleetSpec, out: Path) -> None:
    """What `simulate_fleet` writes, into a folder that the caller may change."""
    kept = KEPT / of_sources() / hashlib.sha256(repr(spec).encode()).hexdigest()[:16]
    if not kept.is_dir():
        kept.parent.mkdir(parents=True, exist_ok=True)
        forget()
        made = Path(tempfile.mkdtemp(prefix="making-", dir=kept.parent))
        simulate_fleet(spec, made)
        with suppress(OSError):  # another worker's were there first, and are the same
            made.rename(kept)
        shutil.rmtree(made, ignore_errors=True)
    shutil.copytree(kept, out, dirs_exist_ok=True)


def forget() -> None:
    """Remove the days of sources that are long gone, and what a killed run began."""
    for folder in (*KEPT.iterdir(), *KEPT.glob("*/making-*")):
        if time.time() - folder.stat().st_mtime > FORGOTTEN_AFTER_S:
            shutil.rmtree(folder, ignore_errors=True)


@cache
def of_sources() -> str:
    """Hash of all that a simulated log depends on: our files, and the releases of other people's."""
    digest = hashlib.sha256(sys.version.encode())
    for path in sources_of("pipeline.simulate.fleet"):
        digest.update(path.read_bytes())
    releases = sorted(f"{d.name}=={d.version}" for d in distributions() if d.name != "boresight")
    digest.update("\n".join(releases).encode())
    return digest.hexdigest()[:16]


def sources_of(module: str) -> list[Path]:
    """The files that a module of ours imports, and those that they import, itself among them."""
    found: dict[str, Path] = {}
    wanted = [module]
    while wanted:
        name = wanted.pop()
        path = REPO / name.replace(".", "/")
        path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        if name in found or not path.is_file():  # seen, or a name inside a module
            continue
        found[name] = path
        wanted += [name.rpartition(".")[0]] if "." in name else []
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                wanted += [a.name for a in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                wanted += [node.module, *(f"{node.module}.{a.name}" for a in node.names)]
    return [found[name] for name in sorted(found)]
