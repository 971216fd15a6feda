"""Examples to read and to change: cells for a notebook, scripts too."""
