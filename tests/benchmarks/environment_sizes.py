"""How large are the environments: the night's, from the built wheel, and all of `make setup`?

    python tests/benchmarks/environment_sizes.py [--folder FOLDER] --out tests/benchmarks/results/environment_sizes.json

FOLDER gets an empty environment with the wheel of this checkout and what it asks for (no extra), pinned by
constraints.txt; it is built anew each time and needs a package index. Without it, the night's environment is the
distributions that Boresight asks for, as `make setup` installed them, pip and the wheel aside. Measured is what
`du --apparent-size` counts, links left out, and the largest packages. Compiled Python (.pyc) is left out of both: it
comes with use.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
import venv
from collections import Counter
from collections.abc import Iterable
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

from tests.benchmarks.studies.commits import commit_now
from tests.makers.third_party import installed

__all__ = ["build_night", "measure_environment", "measure_installed_night"]

REPO = Path(__file__).resolve().parents[2]
_LARGEST = 8


def main() -> None:
    """Build the night's environment, measure both, write one JSON object."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, help="scratch for the night's environment")
    parser.add_argument("--setup", type=Path, default=Path(sys.prefix), help="environment of `make setup`")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    measured = {
        "date": time.strftime("%Y-%m-%d"),
        "commit": commit_now(),
        "python": sys.version.split()[0],
        "night": measure_environment(build_night(args.folder)) if args.folder else measure_installed_night(),
        "make setup": measure_environment(args.setup),
    }
    args.out.write_text(json.dumps(measured, indent=1) + "\n")
    print(args.out.read_text(), end="")


def build_night(folder: Path) -> Path:
    """An environment that holds the wheel of this checkout, what it asks for, and nothing else; its folder."""
    shutil.rmtree(folder, ignore_errors=True)
    wheels, environment = folder / "wheel", folder / "venv"
    _pip("wheel", "--quiet", "--no-deps", "--wheel-dir", str(wheels), str(REPO))
    [wheel] = wheels.glob("boresight-*.whl")
    venv.create(environment)
    into = ("--python", str(environment / "bin" / "python"), "install", "--quiet", "--no-compile")
    _pip(*into, "-c", str(REPO / "constraints.txt"), str(wheel))
    return environment


def measure_environment(environment: Path) -> dict[str, Any]:
    """Size of an environment, how many files it has, and its largest packages [MB]."""
    return _measured((path, path.relative_to(environment)) for path in environment.rglob("*"))


def measure_installed_night() -> dict[str, Any]:
    """The same of what a night needs of the environment that this runs in."""
    files = [file for name in sorted(installed(())) for file in distribution(name).files or []]
    return _measured((Path(str(file.locate())), Path("site-packages", file)) for file in files)


def _measured(files: Iterable[tuple[Path, Path]]) -> dict[str, Any]:
    """Sizes of files, with their places below the environment's folder."""
    sizes = Counter[str]()
    count = 0
    for path, place in files:
        if path.is_symlink() or not path.is_file() or path.suffix == ".pyc":
            continue
        count += 1
        sizes[_package(place)] += path.stat().st_size
    largest = {name: round(size / 1e6, 1) for name, size in sizes.most_common(_LARGEST)}
    return {"megabytes": round(sizes.total() / 1e6, 1), "files": count, "largest_megabytes": largest}


def _package(path: Path) -> str:
    """Folder below site-packages that a file belongs to; shared libraries beside a package count with it."""
    parts = path.parts
    below = parts[parts.index("site-packages") + 1] if "site-packages" in parts else parts[0]
    return below.removesuffix(".libs")


def _pip(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments], check=True)


if __name__ == "__main__":
    main()
