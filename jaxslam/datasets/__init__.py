"""Readers of recorded data with truth, as runs for the filters of `jaxslam.consistency`."""
