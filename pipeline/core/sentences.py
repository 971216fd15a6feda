"""Sentences of a room as one list: templates by name, with fields that are filled where a sentence is given."""

from __future__ import annotations

from collections.abc import Callable, Mapping

__all__ = ["sentences_of"]


def sentences_of(templates: Mapping[str, str]) -> Callable[..., str]:
    """A function that gives a sentence by its name, with its fields filled."""

    def because(name: str, /, **fields: object) -> str:
        return templates[name].format(**fields)

    return because
