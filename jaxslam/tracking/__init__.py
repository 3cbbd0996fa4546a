"""Image patches, tracking and what is written of it; needs the extra `vision`."""
