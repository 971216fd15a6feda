"""Processing of many vehicle-days: executors and the nightly run."""
