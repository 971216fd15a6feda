"""Opens the window on the lake that is named, presses its keys, and prints what it then shows."""

import json
import sys
import threading
import time
from pathlib import Path

from open3d.visualization import gui

sys.path.insert(0, str(Path(__file__).resolve().parent.parent.parent))

from jobs.view import _rig
from pipeline.store.partitions import Lake
from pipeline.view.layers import read_moment
from pipeline.view.window import Viewer
from tests.export.test_foxglove_rig import DAY

lake = Lake.at(sys.argv[1])
gui.Application.instance.initialize()
viewer = Viewer(
    "test",
    _rig(lake, DAY.vehicle, DAY.day, "joint"),
    read_moment(lake, DAY, 0),
    lambda n: read_moment(lake, DAY, n),
)
seen = {"states": [], "moments": []}


class Press:
    type = gui.KeyEvent.Type.DOWN

    def __init__(self, key):
        self.key = key


def look():
    seen["states"].append(viewer.state)
    seen["moments"].append(viewer._shown.number)


def press():
    look()
    viewer.press(Press(gui.KeyName.SPACE))
    viewer.press(Press(gui.KeyName.RIGHT))
    viewer.turn("front", "yaw", 3.0)
    look()
    seen["turned"] = [viewer.turned, viewer.axis, viewer.angle_deg]


def later():
    for do in (press, viewer.window.close):
        time.sleep(2)
        gui.Application.instance.post_to_main_thread(viewer.window, do)


threading.Thread(target=later, daemon=True).start()
gui.Application.instance.run()
print(json.dumps(seen | {"ended": True}), flush=True)
