"""Templates to HTML: one file, no outside resources."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

__all__ = ["is_drawn", "mark_drawn", "render", "write_page"]

_MARK = "<!-- drawn from {} -->\n"  # the last line of a page that is not drawn again while it stays true


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


def write_page(path: Path, html: str) -> Path:
    """Write a page aside and rename it, so that nobody opens half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, aside = tempfile.mkstemp(dir=path.parent, prefix=".writing-", suffix=".tmp")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(html)
        Path(aside).chmod(0o644)
        Path(aside).replace(path)
    except BaseException:
        Path(aside).unlink(missing_ok=True)
        raise
    return path


def is_drawn(path: Path, stamp: str) -> bool:
    """Whether a page is there whose mark says that it was drawn from the same."""
    mark = _MARK.format(stamp).encode()
    try:
        with path.open("rb") as stream:
            stream.seek(-len(mark), os.SEEK_END)
            return stream.read() == mark
    except OSError:  # not there, or shorter than a mark
        return False


def mark_drawn(path: Path, stamp: str) -> None:
    """Say at a page's end what it was drawn from."""
    with path.open("ab") as stream:
        stream.write(_MARK.format(stamp).encode())


def _safe_json(text: str) -> Markup:
    """JSON inside a script element: the only sequence that could end it is escaped."""
    return Markup(json.dumps(json.loads(text)).replace("<", "\\u003c"))  # noqa: S704 (escaped one call before)
