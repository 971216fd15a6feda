"""Commands as a user gives them: what they return and print."""

import json
from typing import NamedTuple

from jobs.cli import main


class Told(NamedTuple):
    code: int
    summary: dict | list  # the last line of stdout
    out: str
    err: str


def command(capsys, *arguments):
    """Run `boresight ARGUMENTS`; what was printed before is dropped."""
    capsys.readouterr()
    code = main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    lines = out.splitlines()
    try:
        summary = json.loads(lines[-1]) if lines else {}
    except json.JSONDecodeError:
        summary = {}
    return Told(code, summary, out, err)
