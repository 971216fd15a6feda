"""Templates to HTML: one file, no outside resources."""

from __future__ import annotations

import json
from pathlib import PurePath
from typing import Any, TypeVar

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from pipeline.store.files import Files, LocalFiles

__all__ = ["render", "write_page"]

P = TypeVar("P", bound=PurePath)


def render(template: str, **values: Any) -> str:
    """HTML of a template of this package; an undefined name is an error."""
    environment = Environment(
        loader=PackageLoader("pipeline.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    environment.filters["safe_json"] = _safe_json
    return environment.get_template(template).render(**values)


def write_page(path: P, html: str, files: Files | None = None) -> P:
    """Write a page aside and give it its name, so that nobody opens half of it.

    Args:
        path: of the page.
        html: its content.
        files: where it is; None = this machine.
    """
    with (files or LocalFiles()).replacing(path) as stream:
        stream.write(html.encode())
    return path


def _safe_json(text: str) -> Markup:
    """JSON inside a script element: the only sequence that could end it is escaped."""
    return Markup(json.dumps(json.loads(text)).replace("<", "\\u003c"))  # noqa: S704 (escaped one call before)
