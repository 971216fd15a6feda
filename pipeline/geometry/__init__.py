"""Mathematics of frames, cameras and angles; conventions in CONVENTIONS.md."""
