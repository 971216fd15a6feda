"""Three log containers behind one interface."""
