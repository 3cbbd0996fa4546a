"""The pieces of a filter: camera, sensors, motion, coordinates, calibration, depth, unit of length.

`number_field` and `AnyArray` are for pieces of your own.
"""

from jaxslam._numerics.arrays import AnyArray, number_field

__all__ = ["AnyArray", "number_field"]
