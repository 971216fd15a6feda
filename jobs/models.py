"""`boresight models`: shipped networks and networks to download, with purpose, licence and integrity."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from jobs.terminal.summary import print_summary, progress_reporter
from pipeline.core.errors import ConfigError
from pipeline.core.models import (
    CATALOGUE,
    ThirdPartyModel,
    manifest_text,
    named,
    semantics_line,
    shipped_models,
)
from pipeline.perceive.models.download import download
from pipeline.store.atomic_write import atomic_write

__all__ = ["models"]


def models(
    *names: str,
    fetch: bool = False,
    into: Path = Path("models"),
    mirror: str | None = None,
    json: bool = False,
) -> int:
    """List the shipped models and those that --fetch downloads.

    Each shipped file is compared with the sha256 in its card. Exit code 1 if one differs, or a card is incomplete.

    Args:
        names: models to fetch; default: a segmenter and a detector. A camera without logged labels needs both.
        fetch: download third-party models, with manifests. Address, size and licence are printed first. A file with
            another sha256 is discarded.
        into: folder for the files; fleet.toml names it relative to itself.
        mirror: address of a folder with the files NAME.onnx, in place of the pinned addresses.
        json: put the whole cards into "models" and "to_fetch" of the summary.
    """
    if fetch:
        return _fetch(named(names), into, mirror)
    if names:
        raise ConfigError(
            "command line", "NAME", f"{' '.join(names)}: add --fetch to download models by name"
        )
    found = shipped_models()
    for model in () if json else found:
        card = model.card
        size = f"{card.get('bytes', 0) / 1e6:.1f} MB, {card.get('parameters', 0):,} parameters"
        rows = {
            "for": card.get("purpose", ""), "licence": card.get("license", ""), "size": size,
            "sha256": card.get("sha256", ""), "made by": card.get("command", ""),
            "card": str(model.file.with_suffix(".md")), "file": "; ".join(model.problems) or "as in its card",
        }  # fmt: skip
        _print_block(model.name, rows)
    for other in () if json else CATALOGUE:
        _print_block(f"{other.name} (to download: boresight models --fetch {other.name})", _facts(other))
    wrong = any(model.problems for model in found)
    told = [
        {"name": m.name, "path": m.file, "problems": m.problems} | (m.card if json else {}) for m in found
    ]
    others = [asdict(other) if json else other.name for other in CATALOGUE]
    print_summary("models", "failed" if wrong else "done", models=told, to_fetch=others)
    return 1 if wrong else 0


def _fetch(chosen: Sequence[ThirdPartyModel], into: Path, mirror: str | None) -> int:
    fetched, there = list[str](), list[str]()
    for model in chosen:
        _print_block(model.name, _facts(model))
        url = f"{mirror.rstrip('/')}/{model.name}.onnx" if mirror else model.url
        with progress_reporter(f"fetch {model.name}") as progress:
            came = download(url, into / f"{model.name}.onnx", model.size_bytes, model.sha256, progress)
        (fetched if came else there).append(model.name)
        manifest = into / f"{model.name}.toml"
        if came or not manifest.exists():  # what a user changed in it stays
            with atomic_write(manifest) as file:
                file.write(manifest_text(model).encode())
    line = semantics_line(str(into))
    print_summary(
        "models",
        "done",
        fetched=fetched,
        already_there=there,
        into=str(into),
        enter_in_fleet_toml=f"[rigs.NAME.camera]\n{line}",
        next_steps=[f"enter the `semantics` line under the camera in fleet.toml: {line}"],
    )
    return 0


def _facts(model: ThirdPartyModel) -> dict[str, str]:
    purpose = {"segment": "semantic labels of images", "detect": "road users in images"}[model.task]
    return {
        "for": purpose, "licence": model.licence, "its text": model.licence_url,
        "size": f"{model.size_bytes / 1e6:.1f} MB", "from": model.url, "sha256": model.sha256,
        "tried here": model.tried,
    }  # fmt: skip


def _print_block(title: str, rows: Mapping[str, object]) -> None:
    """One model, for people, on stderr."""
    lines = [title, *(f"  {name:8} {value}" for name, value in rows.items())]
    sys.stderr.write("\n".join(lines) + "\n")
