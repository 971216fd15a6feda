"""Networks that perception uses, trained weakly from the other sensors, by one trainer."""

from typing import Any

from pipeline.learn.perception_training import lidar_semantics, radar_drivable
from pipeline.learn.perception_training.trainer import Task

__all__ = ["TASKS"]

TASKS: dict[str, type[Task[Any]]] = {
    task.name: task for task in (lidar_semantics.LidarSemantics, radar_drivable.RadarDrivable)
}
