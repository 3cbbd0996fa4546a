"""Small numerics in JAX that every room stands on: arrays, factorisations, least squares."""
