# %% [markdown]
# # What a lake contains of a vehicle
# Cells for a notebook (VS Code, Spyder, PyCharm, jupytext); as a script:
#
#     python -m jobs.examples.read_a_lake [LAKE VEHICLE PICTURES]
#
# after `make demo`, which leaves the lake that is read by default. Beside Boresight it needs polars and
# matplotlib (`pip install 'boresight[test,dev]'`). All columns, with units and frames: schemas/README.md.

# %%
from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import polars as pl
from matplotlib.figure import Figure

from pipeline.geometry.cameras import Camera
from pipeline.geometry.changes import change_between, change_covariance
from pipeline.geometry.se3 import from_quaternion, transform_points

LAKE, VEHICLE, PICTURES = sys.argv[1:4] if len(sys.argv) > 3 else ("demo/lake", "vehicle-2", "demo")
PAIR = "camera_lidar"
Path(PICTURES).mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## The records
# Calibrations are a Delta table: read it through its log, never by glob. A day that was calibrated again has
# several records; the one asserted last is current.

# %%
records = (
    pl.scan_delta(f"{LAKE}/calibrations")
    .filter(pl.col("vehicle") == VEHICLE, pl.col("method") == "joint")
    .sort("asserted_at", "work_key")
    .unique(["day", "pair"], keep="last")
    .sort("day", "pair")
    .collect()
)
print(records.select("day", "pair", "status", "azimuth_sigma_rad", "reason"))

# %% [markdown]
# ## History
# Poses are T_parent_child with the quaternion's scalar first; arrays are little-endian blobs, here 6x6
# float64 of (rotation, translation). Changes count from the first accepted day: rotation about, shift along
# the parent's axes.

# %%
POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")


def poses(table: pl.DataFrame, prefix: str = "") -> np.ndarray:
    """T_parent_child of every row, (N, 4, 4)."""
    numbers = table.select(prefix + name for name in POSE).to_numpy()
    return np.array([from_quaternion(row[:4], row[4:]) for row in numbers]).reshape(-1, 4, 4)


history = records.filter(pl.col("pair") == PAIR, pl.col("qw").is_not_null())
T = poses(history)
blobs = history["covariance"]
covariance = np.array([np.frombuffer(blob, "<f8").reshape(6, 6) for blob in blobs]).reshape(-1, 6, 6)
is_accepted = (history["status"] == "accepted").to_numpy()
if not is_accepted.any():
    sys.exit(f"no accepted {PAIR} of {VEHICLE} in {LAKE}: there is no history to draw")
first = int(np.argmax(is_accepted))
in_units = np.array([np.degrees(1.0)] * 3 + [100.0] * 3)
change = change_between(np.broadcast_to(T[first], T.shape), T) * in_units
sigma = np.sqrt(np.diagonal(change_covariance(T, covariance), axis1=1, axis2=2)) * in_units

# %%
figure = Figure(figsize=(12, 6), layout="constrained")
names = [f"rotation about {axis} [deg]" for axis in "xyz"] + [f"shift along {axis} [cm]" for axis in "xyz"]
for k, (axes, name) in enumerate(zip(figure.subplots(2, 3, sharex=True).flat, names, strict=True)):
    days = np.arange(len(T))
    for sigmas, opacity in ((3, 0.12), (1, 0.25)):
        low, high = change[:, k] - sigmas * sigma[:, k], change[:, k] + sigmas * sigma[:, k]
        axes.fill_between(
            days, low, high, color="tab:blue", alpha=opacity, linewidth=0, label=f"{sigmas} sigma"
        )
    axes.plot(
        days[is_accepted], change[is_accepted, k], "o-", color="tab:blue", markersize=4, label="accepted"
    )
    axes.plot(days[~is_accepted], change[~is_accepted, k], "x", color="tab:orange", label="held")
    axes.axhline(0, color="black", linewidth=0.6)
    axes.set_title(name, fontsize=10)
    step = -(-len(days) // 6)  # six dates at most, otherwise they overlap
    axes.set_xticks(days[::step], history["day"].to_list()[::step], rotation=30, ha="right", fontsize=8)
figure.axes[0].legend(fontsize=8)
figure.suptitle(f"{VEHICLE}, {PAIR}: change since {history['day'][first]}")
figure.savefig(f"{PICTURES}/history.png", dpi=110)

# %% [markdown]
# ## One frame at one record
# Images and sweeps are plain Parquet, a file per vehicle, day and sensor, joined by the moment; only what is
# asked for is read. The picture's left half is drawn at the prior, its right half at the record.

# %%
record = history.filter(pl.col("status") == "accepted").tail(1)
day = record["day"][0]
camera_file, lidar_file = (
    f"{LAKE}/{table}/vehicle={VEHICLE}/day={day}/{record[side][0]}.parquet"
    for table, side in (("images", "parent_frame"), ("sweeps", "child_frame"))
)
frames = pl.scan_parquet(camera_file).join(pl.scan_parquet(lidar_file), on="moment").sort("moment")
middle = frames.select(pl.len()).collect().item() // 2
columns = ["image", "image_width_px", "image_height_px", "camera_model", "camera_K", "camera_D"]
columns += [f"lidar_{axis}_m" for axis in "xyz"]
frame = frames.select(columns).slice(middle, 1).collect().row(0, named=True)
camera = Camera(
    frame["camera_model"],
    np.frombuffer(frame["camera_K"], "<f8").reshape(3, 3),
    np.frombuffer(frame["camera_D"], "<f8"),
    frame["image_width_px"],
    frame["image_height_px"],
)
xyz = [np.frombuffer(frame[f"lidar_{axis}_m"], "<f4").astype(float) for axis in "xyz"]
points_lidar = np.stack(xyz, axis=1)

# %%
picture = cv2.imdecode(np.frombuffer(frame["image"], np.uint8), cv2.IMREAD_COLOR)
assert picture is not None, "the frame's image is damaged"
half = picture.shape[1] // 2
for T_camera_lidar, is_left in ((poses(record, "prior_")[0], True), (poses(record)[0], False)):
    points_camera = transform_points(T_camera_lidar, points_lidar)
    uv, is_valid = camera.project(points_camera)
    is_seen = is_valid & camera.contains(uv) & ((uv[:, 0] < half) == is_left)
    range_m = np.linalg.norm(points_camera[is_seen], axis=1)
    near = 1 - np.log(range_m / 4) / np.log(80 / 4)  # 4 m red, 80 m blue
    level = np.clip(255 * near, 0, 255).astype(np.uint8)
    colours = cv2.applyColorMap(level, cv2.COLORMAP_TURBO).reshape(-1, 3)
    for (u, v), colour in zip(uv[is_seen], colours, strict=True):
        cv2.circle(picture, (round(u), round(v)), 2, colour.tolist(), -1)
cv2.line(picture, (half, 0), (half, picture.shape[0]), (255, 255, 255), 2)
cv2.imwrite(f"{PICTURES}/overlay.png", picture)
print(f"{PICTURES}/history.png, {PICTURES}/overlay.png ({day})")
