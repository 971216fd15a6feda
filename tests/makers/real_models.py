"""Manifests of the real segmenter and detector, as the README of perceive gives them."""

import hashlib
import re
from pathlib import Path

from pipeline import perceive

__all__ = ["write_real_manifests"]


def write_real_manifests(folder: Path, segmenter: Path, detector: Path) -> None:
    """segmenter.toml and detector.toml for the models' files, into a folder."""
    text = (Path(perceive.__file__).parent / "README.md").read_text()
    blocks = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    for name, model, task in (("segmenter", segmenter, "segment"), ("detector", detector, "detect")):
        (manifest,) = (b for b in blocks if f'task = "{task}"' in b)
        manifest = re.sub(r'path = "[^"]*"', f'path = "{model}"', manifest)
        digest = hashlib.sha256(model.read_bytes()).hexdigest()
        (folder / f"{name}.toml").write_text(manifest.replace('"..."', f'"{digest}"'))
