"""Which code made a result, and whether two commits calibrate alike."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from functools import lru_cache

__all__ = ["EVERY", "commit_now", "is_accepted"]

# What decides results: a commit that changes nothing here (a document, a study's table) makes the same numbers.
_DECIDING = ("pipeline", "schemas")
EVERY = "all"


def commit_now() -> str:
    """The commit, with a + where the working tree differs from it in what decides results."""
    head = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    )
    changed = subprocess.run(
        ["git", "diff", "--quiet", "HEAD", "--", *_DECIDING], capture_output=True, check=False
    )
    return (head.stdout.strip() or "unknown") + ("+" if changed.returncode else "")


@lru_cache(maxsize=256)
def _is_same_code(first: str, second: str) -> bool:
    """Both commits hold the same code, as far as it decides results.

    Nobody knows what a working tree with changes (a + at the end) held, or a commit that is not in this repository:
    these are never the same.
    """
    if "+" in first + second or "unknown" in (first, second):
        return False
    if first == second:
        return True
    done = subprocess.run(
        ["git", "diff", "--quiet", first, second, "--", *_DECIDING], capture_output=True, check=False
    )
    return done.returncode == 0


def is_accepted(commit: str, now: str, accepted: Sequence[str]) -> bool:
    """A line by `commit` counts as done at commit `now`."""
    return EVERY in accepted or commit in accepted or _is_same_code(commit, now)
