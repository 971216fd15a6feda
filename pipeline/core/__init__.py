"""What every room stands on: configuration, errors, stages and how they run."""
