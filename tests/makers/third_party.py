"""Every distribution that Boresight with all extras of a user brings, with its licence (by pip-licenses).

python -m tests.makers.third_party    prints jobs/deploy/THIRD_PARTY_LICENSES.md (`make licenses`)
"""

import json
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

HEADING = """\
# Licences of what Boresight installs

What Boresight with every extra that a user can ask for (EXTRAS) brings beside Boresight itself, with the
licence that each distribution states. Nothing of it is shipped with Boresight. Written by `make licenses`;
`tests/test_licenses.py` compares it with the licences that go together with Apache-2.0. On Linux PyPI's torch may
bring NVIDIA's own libraries as well, under NVIDIA's licence; a CPU build of torch does not. opencv's wheel holds
FFmpeg's libraries (LGPL-2.1), unchanged and loaded at run time. PyAV (`[video]`) states its own licence; its wheel
holds FFmpeg with x264 and x265, which are under the GPL: who passes that wheel on owes what the GPL asks. Written in
the environment of `make view`, which leaves out `[gpu]`: onnxruntime-gpu (MIT) takes the place of onnxruntime, and
asks for NVIDIA's libraries.

"""
# Who states the whole text in place of a name: words of it, and the name.
TEXTS = {"embreex": ("Redistributions in binary form must reproduce", "BSD-2-Clause")}
OF_DEVELOPERS = ("test", "dev")
IN_PLACE_OF_ANOTHER = ("gpu",)  # cannot be installed beside what it replaces
OF_A_GPU = ("nvidia-", "cuda-")  # libraries of torch's CUDA build, absent from the CPU build


def user_extras():
    """Extras that users install beside each other, and what each asks for; those of developers are left out."""
    project = tomllib.loads((Path(__file__).parent.parent.parent / "pyproject.toml").read_text())["project"]
    return project["dependencies"], {
        e: lines
        for e, lines in project["optional-dependencies"].items()
        if e not in (*OF_DEVELOPERS, *IN_PLACE_OF_ANOTHER)
    }


def installed(extras=None):
    """Names of all distributions that Boresight and extras (None = all) need, directly and through others."""
    dependencies, known = user_extras()
    lines = [*dependencies, *(line for e in (known if extras is None else extras) for line in known[e])]
    found, waiting = set(), [(Requirement(line), "") for line in lines]
    while waiting:
        need, extra = waiting.pop()
        name = canonicalize_name(need.name)
        if (need.marker and not need.marker.evaluate({"extra": extra})) or name.startswith(OF_A_GPU):
            continue
        try:
            needed = [Requirement(line) for line in requires(name) or []]
        except PackageNotFoundError:
            continue  # of another platform or another build
        if (name, frozenset(need.extras)) not in found:
            found.add((name, frozenset(need.extras)))
            waiting += [(n, e) for n in needed for e in ("", *need.extras)]
    return {name for name, _ in found}


def licences():
    """Rows of pip-licenses: Name, Version, License (a short name), by name."""
    command = f"{sys.executable} -m piplicenses --from=mixed --with-system --format=json --packages".split()
    done = subprocess.run([*command, *sorted(installed())], capture_output=True, text=True, check=True)
    rows = json.loads(done.stdout)
    for row in rows:
        words, name = TEXTS.get(row["Name"], ("", ""))
        if words and words in row["License"]:
            row["License"] = name
    return sorted(rows, key=lambda row: row["Name"].lower())


def heading():
    """HEADING with the names of the extras."""
    return HEADING.replace("EXTRAS", ", ".join(f"`[{e}]`" for e in user_extras()[1]))


def table(rows):
    lines = ["| distribution | version | licence |", "|---|---|---|"]
    lines += [
        f"| {r['Name']} | {r['Version'].split('+')[0]} | {' '.join(r['License'].split())} |" for r in rows
    ]
    return heading() + "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(table(licences()), end="")
