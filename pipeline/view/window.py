"""The window: a rotatable scene, keys for prior or calibrated and for moments, and a slider that rotates a sensor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from open3d.visualization import gui, rendering

from pipeline.view.draw import BACKGROUND, VERTICAL_DEG, add_layers, viewpoint
from pipeline.view.layers import AXES, PARTS, STATES, Name, Rig, Shown, layers_of

__all__ = ["Viewer", "open_window"]

_LARGEST_DEG = 5.0  # of the slider
_PANEL_EM = 16


class Viewer:
    """One window on a vehicle-day; `read` returns another moment by its number, or None."""

    def __init__(self, title: str, rig: Rig, shown: Shown, read: Callable[[int], Shown | None]) -> None:
        self._title, self._rig, self._shown, self._read = title, rig, shown, read
        self.state, self.turned, self.axis, self.angle_deg = "calibrated", "", "yaw", 0.0
        self.parts = set(PARTS)
        self._labels: list[Any] = []
        self.window = gui.Application.instance.create_window(title, 1400, 860)
        self._scene = gui.SceneWidget()
        self._scene.scene = rendering.Open3DScene(self.window.renderer)
        self._scene.scene.set_background(BACKGROUND)
        self._scene.scene.view.set_post_processing(False)  # colours as the camera has them
        self._panel, self._said = self._make_panel()
        self.window.add_child(self._scene)
        self.window.add_child(self._panel)
        self.window.set_on_layout(self._lay_out)
        self.window.set_on_key(self.press)
        self._draw()
        self._scene.setup_camera(VERTICAL_DEG, self._scene.scene.bounding_box, np.zeros(3))
        self._scene.look_at(*viewpoint(rig), [0, 0, 1])

    def press(self, event: Any) -> bool:
        """Space: switch between prior and calibrated; left, right: previous, next moment. True for these keys."""
        if event.type != gui.KeyEvent.Type.DOWN:
            return False
        if event.key == gui.KeyName.SPACE:
            self.state = STATES[1 - STATES.index(self.state)]
        elif event.key in (gui.KeyName.LEFT, gui.KeyName.RIGHT):
            step = 1 if event.key == gui.KeyName.RIGHT else -1
            self._shown = self._read(self._shown.number + step) or self._shown
        else:
            return False
        self._draw()
        return True

    def turn(self, sensor: str, axis: str, angle_deg: float) -> None:
        """Show a sensor rotated about an axis of the car."""
        self.turned, self.axis, self.angle_deg = sensor, axis, angle_deg
        self._draw()

    def _draw(self) -> None:
        T = self._rig.placed(self.state, self.turned, self.axis, float(np.radians(self.angle_deg)))
        layers, scene = layers_of(self._shown, self._rig, T), self._scene.scene
        scene.clear_geometry()
        for label in self._labels:
            self._scene.remove_3d_label(label)
        add_layers(scene, layers, self.parts, self.window.scaling)
        named = [layer for layer in layers if isinstance(layer, Name) and "names" in self.parts]
        self._labels = [self._scene.add_3d_label(layer.xyz, layer.text) for layer in named]
        for label, layer in zip(self._labels, named, strict=True):
            label.color = gui.Color(*layer.rgb)
        self._said.text = f"{self.state.upper()}\nmoment {self._shown.number}"
        self._scene.force_redraw()

    def _make_panel(self) -> tuple[Any, Any]:
        em = self.window.theme.font_size
        panel, said = gui.Vert(0.4 * em, gui.Margins(em, em, em, em)), gui.Label("")
        keys = gui.Label("space: prior / calibrated\nleft, right: moments\nmouse: rotate, wheel: zoom")
        for child in (gui.Label(self._title), said, keys):
            panel.add_child(child)
        for part in PARTS:
            box = gui.Checkbox(part)
            box.checked = True
            box.set_on_checked(lambda on, part=part: self._show_part(part, on=on))
            panel.add_child(box)
        sensors, axes = gui.Combobox(), gui.Combobox()
        for name in self._rig.poses["calibrated"]:
            sensors.add_item(name)
        for axis in AXES:
            axes.add_item(axis)
        axes.selected_text = self.axis
        slider = gui.Slider(gui.Slider.DOUBLE)
        slider.set_limits(-_LARGEST_DEG, _LARGEST_DEG)

        def chosen(*_: Any) -> None:
            self.turn(sensors.selected_text, axes.selected_text, slider.double_value)

        slider.set_on_value_changed(chosen)
        sensors.set_on_selection_changed(chosen)
        axes.set_on_selection_changed(chosen)
        for child in (gui.Label("turn a sensor [deg]"), sensors, axes, slider):
            panel.add_child(child)
        return panel, said

    def _show_part(self, part: str, *, on: bool) -> None:
        (self.parts.add if on else self.parts.discard)(part)
        self._draw()

    def _lay_out(self, _: Any) -> None:
        area, width = self.window.content_rect, _PANEL_EM * self.window.theme.font_size
        self._scene.frame = gui.Rect(area.x, area.y, area.width - width, area.height)
        self._panel.frame = gui.Rect(area.get_right() - width, area.y, width, area.height)


def open_window(title: str, rig: Rig, shown: Shown, read: Callable[[int], Shown | None]) -> None:
    """Show the window until it is closed."""
    app = gui.Application.instance
    app.initialize()
    Viewer(title, rig, shown, read)
    app.run()
