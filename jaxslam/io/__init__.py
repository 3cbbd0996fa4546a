"""Videos: where they come from, what camera filmed them, how one is calibrated; extra `vision`."""
