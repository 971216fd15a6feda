"""Commands as a user gives them: what they return and print."""

import json
import os
import subprocess
import sys
from typing import NamedTuple

from jobs.cli import main

BORESIGHT = f"{sys.prefix}/bin/boresight"


class Told(NamedTuple):
    code: int
    summary: dict | list  # the last line of stdout
    out: str
    err: str


def command(capsys, *arguments):
    """Run `boresight ARGUMENTS`; what was printed before is dropped."""
    capsys.readouterr()
    code = main([str(a) for a in arguments])
    return _told(code, *capsys.readouterr())


def boresight(*arguments, **environment):
    """Run the installed command in a process of its own."""
    call, env = [BORESIGHT, *map(str, arguments)], os.environ | environment
    done = subprocess.run(call, env=env, capture_output=True, text=True, check=False, timeout=1800)
    return _told(done.returncode, done.stdout, done.stderr)


def _told(code, out, err):
    lines = out.splitlines()
    try:
        summary = json.loads(lines[-1]) if lines else {}
    except json.JSONDecodeError:
        summary = {}
    return Told(code, summary, out, err)
