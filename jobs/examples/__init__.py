"""Examples to read and to change: notebook cells that also run as scripts."""
