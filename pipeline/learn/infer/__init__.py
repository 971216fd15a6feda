"""A frame or a vehicle-day by exported networks; nothing here needs torch."""
