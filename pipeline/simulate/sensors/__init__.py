"""What is mounted on a vehicle and what it measures of the world."""
