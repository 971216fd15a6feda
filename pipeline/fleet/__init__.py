"""Many vehicle-days: executors and the nightly run."""
