"""Stage prepare: frames and observations of many days to table `training`."""
