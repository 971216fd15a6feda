"""Which shared libraries a command loads, with all processes that it starts, and which of them a bare system lacks.

glibc's loader tells itself (LD_DEBUG, see ld.so(8)): one file per process, so no short-lived worker is missed.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

# The C and C++ runtime on the list of PEP 600 (manylinux_2_17; so also of PEP 513, 571 and 599). What else is on that
# list, libX11, libGL and libglib, belongs to a desktop: a bare Debian has none of it, so nothing may load it here.
ALWAYS_THERE = {
    "ld-linux-aarch64.so.1",
    "ld-linux-x86-64.so.2",
    "libanl.so.1",
    "libc.so.6",
    "libdl.so.2",
    "libgcc_s.so.1",
    "libm.so.6",
    "libnsl.so.1",
    "libpthread.so.0",
    "libresolv.so.2",
    "librt.so.1",
    "libstdc++.so.6",
    "libutil.so.1",
}
# Plugins of the resolver, which glibc loads as /etc/nsswitch.conf of that very machine tells it.
_CHOSEN_BY_THE_SYSTEM = re.compile(r"libnss_\w+\.so\.2")
_LOADED = re.compile(rb"calling init: (\S+)")
# Modules of the standard library that stand on a library of the system: such a library is the interpreter's own.
_OF_THE_INTERPRETER = "import bz2, ctypes, hashlib, lzma, pyexpat, sqlite3, ssl, uuid, zlib"


def tracing(folder):
    """Environment in which every process writes the libraries that it loads into a file of the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    return os.environ | {"LD_DEBUG": "libs", "LD_DEBUG_OUTPUT": str(folder / "process")}


def loaded(folder):
    """Paths of all libraries that were loaded by processes run in `tracing(folder)`, and the number of these."""
    files = list(folder.glob("process.*"))
    return {m.decode() for f in files for m in _LOADED.findall(f.read_bytes())}, len(files)


def foreign(paths, folder, python=sys.executable):
    """Those of the paths that neither the environment of `python`, its interpreter nor a bare system brings.

    Args:
        paths: of shared libraries.
        folder: to trace the interpreter in.
        python: of the environment that loaded them.
    """
    subprocess.run([python, "-I", "-c", _OF_THE_INTERPRETER], env=tracing(folder), check=True)
    own = {Path(p).resolve() for p in loaded(folder)[0]}
    code = "import sys; print(sys.prefix, sys.base_prefix, sep='\\n')"
    told = subprocess.run([python, "-I", "-c", code], capture_output=True, text=True, check=True).stdout
    # An interpreter in /usr does not make all of /usr its own.
    homes = [Path(h).resolve() for h in told.splitlines() if Path(h) not in (Path("/usr"), Path("/"))]
    return {
        p
        for p in paths
        if Path(p).name not in ALWAYS_THERE
        and not _CHOSEN_BY_THE_SYSTEM.fullmatch(Path(p).name)
        and Path(p).resolve() not in own
        and not any(Path(p).resolve().is_relative_to(h) for h in homes)
        and not re.search(r"/python3\.\d+/lib-dynload/|/libpython3", p)
    }
