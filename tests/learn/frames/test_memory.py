"""`export frames` needs no more memory for twice the frames."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

from pipeline.store.partitions import Lake
from tests.makers import training_lakes
from tests.makers.fleet_files import fleet_toml

# Both days are longer than what writers and allocators hold at a time: 5 to 12 MiB more for 160 frames than for 40,
# 1 to 2 MiB more for 320 than for 160. Were frames held, twice as many would be 60 MiB more (see `picture`).
FRAMES, MOST_MIB = 160, 12
EGO = dict.fromkeys(("ego_qx", "ego_qy", "ego_qz", "ego_tx_m", "ego_ty_m", "ego_tz_m"), 0.0)
EGO |= {"ego_qw": 1.0, "ego_speed_mps": 10.0, "ego_yaw_rate_radps": 0.0}
EXPORT = """
import sys
import pyarrow
from jobs.cli import main
# On a busy machine several threads read ahead by another amount in each run.
pyarrow.set_cpu_count(1)
pyarrow.set_io_thread_count(1)
assert main(sys.argv[1:]) == 0
# Not ru_maxrss: a child inherits its parent's.
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(int(peak.split()[1]) / 1024)
"""


@pytest.fixture(scope="module")
def lakes(tmp_path_factory):
    """A lake of one vehicle-day, and one of a day twice as long."""
    noise = np.random.default_rng(0).integers(0, 255, (320, 640, 3)).astype(np.uint8)
    picture = cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    assert len(picture) > 4e5
    made = []
    for frames in (FRAMES, 2 * FRAMES):
        folder = tmp_path_factory.mktemp("lake")
        (folder / "fleet.toml").write_text(fleet_toml("a"))
        training_lakes.fill(Lake.at(folder), "a", "2026-01-01", frames, image=picture, **EGO)
        made.append((frames, folder))
    return made


@pytest.mark.slow
@pytest.mark.parametrize("form", ["parquet", "nuscenes"])
def test_memory_does_not_grow_with_the_number_of_frames(lakes, form, tmp_path):
    peaks_mib = []
    for frames, lake in lakes:
        out = tmp_path / str(frames)
        places = ["--fleet", lake / "fleet.toml", "--lake", lake, "--out", out, "--format", form]
        more = ["--calibration", "prior", "--unsplit", "--executor", "inline"]
        call = [sys.executable, "-c", EXPORT, "export", "frames", *places, *more]
        done = subprocess.run(call, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert f'"train": {frames}' in (out / "card.json").read_text()
        peaks_mib.append(float(done.stdout.splitlines()[-1]))
    few, many = peaks_mib
    assert many - few < MOST_MIB, peaks_mib
