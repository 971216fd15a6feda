"""A model's card: facts about its training run, as JSON and Markdown."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from pipeline.core.errors import ConfigError
from pipeline.learn.infer.onnx_networks import UNFIT
from pipeline.learn.train.loop import BEST, LAST, load_checkpoint, read_metrics

__all__ = ["LIMITS", "card_of_run", "write_card"]

LIMITS = (
    "Trained without ground truth: answers have the losses' biases, which averaging over a fleet does not reduce.",
    "Looks 38 deg to each side of the camera's axis; guesses within about 5 deg, best with 2 or 3 passes.",
    "A single frame determines rotations of camera-lidar best; translations stay close to their guess.",
    "Log variances describe the scatter between frames; they do not include errors common to all frames.",
    "Rigs, lenses or weather that are not in the data were not learned.",
)


def card_of_run(folder: Path, notes: Path | None = None) -> dict[str, Any]:
    """The card of a run of `boresight train`.

    Args:
        notes: JSON object whose entries are placed first: measurements after training, and facts about the
            data.

    Raises:
        ContractError: no readable checkpoint.
        ConfigError: notes that are no JSON object.
    """
    best = (folder / BEST).exists()
    chosen, last = load_checkpoint(folder / (BEST if best else LAST)), load_checkpoint(folder / LAST)
    config = chosen["config"]
    validation = {
        k.removeprefix("validation/"): v
        for report in read_metrics(folder)
        if report["step"] <= chosen["step"]
        for k, v in report.items()
        if k.startswith("validation/")
    }
    unfit = _unfit(chosen["step"], judged=best)
    card = {
        "weights": f"of step {chosen['step']}, {'the best on held-out frames' if best else 'the last'}",
        "data": {key: last[key] for key in ("frames", "data_key") if key in last}
        | {"cell_deg": config["cell_deg"], "frames_per_step": config["batch_size"]},
        "seeds": [config["seed"]],
        "time": {"steps": last["step"], "minutes": round(last.get("trained_s", 0.0) / 60, 1)},
        "results": validation,
        "limits": LIMITS,
        "training": config,
    }
    card |= _notes(notes)
    return card | {"limits": [*unfit, *card["limits"]]}  # which no notes take away


def _unfit(step: int, *, judged: bool) -> list[str]:
    """Warning for weights that no held-out frames chose, or that are those of the start."""
    if not judged:
        return [f"{UNFIT}: no held-out frames have judged it, so that `calibrate` holds all that it finds."]
    if step == 0:
        return [
            f"{UNFIT}: training made no weights that are better on held-out frames than those it began with."
        ]
    return []


def write_card(model: Path, card: dict[str, Any]) -> None:
    """Write the card next to the model's file as .json and .md, with size and sha256."""
    content = model.read_bytes()
    told = {"file": model.name, "bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    card = told | {key: value for key, value in card.items() if key not in told}
    model.with_suffix(".json").write_text(json.dumps(card, indent=2, default=str) + "\n")
    model.with_suffix(".md").write_text(_markdown(card))


def _markdown(card: dict[str, Any]) -> str:
    lines = [f"# Model card of {card['file']}", ""]
    for key, value in card.items():
        if isinstance(value, dict):
            lines += [f"## {key.replace('_', ' ')}", "", *(f"- {k}: {v}" for k, v in value.items()), ""]
        elif isinstance(value, (list, tuple)):
            lines += [f"## {key.replace('_', ' ')}", "", *(f"- {v}" for v in value), ""]
        else:
            lines += [f"- {key.replace('_', ' ')}: {value}", ""]
    return "\n".join(lines)


def _notes(path: Path | None) -> dict[str, Any]:
    if path is None:
        return {}
    try:
        notes = json.loads(path.read_text())
    except (OSError, ValueError) as err:
        raise ConfigError(str(path), "", f"no readable JSON: {err}") from err
    if not isinstance(notes, dict):
        raise ConfigError(str(path), "", "holds no JSON object")
    return notes
