"""Conditionally independent submaps of a filter, the chain that they are, and loops in it."""
