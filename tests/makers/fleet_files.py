"""The smallest fleet.toml: one rig with the topics of the written logs, and what a test adds to it."""

__all__ = ["THREE_SENSORS", "fleet_toml"]

_TOPICS = """
[fleet]
name = "tests"
[rigs.default.camera]
image = "/camera/image"
info = "/camera/info"
semantics = {{ source = "topics", labels = "/perception/labels", detections = "/perception/detections" }}
[rigs.default.lidar]
points = "/lidar/points"
{lidar}
[rigs.default.radar]
points = "/radar/points"
{radar}
"""


def fleet_toml(*vehicles, sections="", lidar="", radar=""):
    """Text of the file.

    Args:
        vehicles: their names, all on rig "default".
        sections: whole sections, as "[solve]\\nseed = 3".
        lidar: further lines of the rig's lidar.
        radar: further lines of its radar.
    """
    named = "".join(f'[vehicles."{vehicle}"]\nrig = "default"\n' for vehicle in vehicles)
    return f"{_TOPICS.format(lidar=lidar, radar=radar)}{sections}\n{named}"


# A rig of one camera, one lidar and one radar, as FleetConfig takes it.
THREE_SENSORS = {
    "camera": {"image": "/i", "info": "/c", "semantics": {"source": "topics", "labels": "/l", "detections": "/d"}},
    "lidar": {"points": "/p"}, "radar": {"points": "/r"},
}  # fmt: skip
