"""Templates to HTML: one file, no outside resources."""

from __future__ import annotations

import json
import re
from pathlib import PurePath
from typing import Any, TypeVar

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from pipeline.core.config import config_hash
from pipeline.store.files import Files, LocalFiles

__all__ = ["page_stem", "render", "write_page"]

P = TypeVar("P", bound=PurePath)
_COPY = '<button type="button" class="copy">Copy</button>'
_PLAIN = re.compile(r"[a-z0-9_-][a-z0-9._-]*[a-z0-9_-]|[a-z0-9_-]")
# Names that Windows keeps for devices, whatever follows the first dot.
_DEVICES = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?")
_READABLE = 60  # letters of an odd name that are kept; what a name differs in may come later


def render(template: str, **values: Any) -> str:
    """HTML of a template of this package; an undefined name is an error."""
    environment = Environment(
        loader=PackageLoader("pipeline.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    environment.filters["safe_json"] = _safe_json
    environment.filters["commands"] = _commands
    return environment.get_template(template).render(**values)


def write_page(path: P, html: str, files: Files | None = None) -> P:
    """Write a page atomically; `files` None = this machine."""
    with (files or LocalFiles()).replacing(path) as stream:
        stream.write(html.encode())
    return path


def _commands(text: str) -> Markup:
    """HTML of a sentence: text between backticks as code, and a command of this program with a button to copy it.

    `templates/fleet.js` does the same to the sentences that it is given.
    """
    html = re.sub(
        r"`([^`]*)`",
        lambda found: f"<code>{found[1]}</code>{_COPY * found[1].startswith('boresight ')}",
        str(escape(text)),
    )
    return Markup(html)  # noqa: S704 (escaped before)


def _safe_json(text: str) -> Markup:
    """JSON inside a script element: the only sequence that could end it is escaped."""
    return Markup(json.dumps(json.loads(text)).replace("<", "\\u003c"))  # noqa: S704 (escaped one call before)


def page_stem(vehicle: str) -> str:
    """File name of a vehicle's pages, without the ending: the vehicle's name if that is plain.

    Some file systems do not distinguish case, accents and signs ("Car" and "car", "a b" and "a_b"). Such a
    name gets "~" and a hash of the whole name; no plain name has a "~".
    """
    if _PLAIN.fullmatch(vehicle) and not _DEVICES.fullmatch(vehicle):
        return vehicle
    readable = re.sub(r"[^a-z0-9_-]", "_", vehicle.lower())[:_READABLE]
    return f"{readable}~{config_hash({'vehicle': vehicle})[:12]}"
