"""Templates to HTML: one file, no outside resources."""

from __future__ import annotations

import json
import re
from pathlib import PurePath
from typing import Any, TypeVar

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from pipeline.store.files import Files, LocalFiles

__all__ = ["commands", "render", "write_page"]

P = TypeVar("P", bound=PurePath)
_COPY = '<button type="button" class="copy">Copy</button>'


def render(template: str, **values: Any) -> str:
    """HTML of a template of this package; an undefined name is an error."""
    environment = Environment(
        loader=PackageLoader("pipeline.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    environment.filters["safe_json"] = _safe_json
    environment.filters["commands"] = commands
    return environment.get_template(template).render(**values)


def write_page(path: P, html: str, files: Files | None = None) -> P:
    """Write a page atomically; `files` None = this machine."""
    with (files or LocalFiles()).replacing(path) as stream:
        stream.write(html.encode())
    return path


def commands(text: str) -> Markup:
    """HTML of a sentence: text between backticks as code, and a command of this program with a button to copy it.

    `templates/fleet.js` does the same to the sentences that it is given.
    """
    html = re.sub(
        r"`([^`]*)`", lambda found: f"<code>{found[1]}</code>{_COPY * _is_ours(found[1])}", str(escape(text))
    )
    return Markup(html)  # noqa: S704 (escaped before)


def _is_ours(command: str) -> bool:
    return command.startswith("boresight ")


def _safe_json(text: str) -> Markup:
    """JSON inside a script element: the only sequence that could end it is escaped."""
    return Markup(json.dumps(json.loads(text)).replace("<", "\\u003c"))  # noqa: S704 (escaped one call before)
