"""One frame as a row of table `training`: the camera's grid, clouds of fixed size."""
