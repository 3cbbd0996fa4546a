"""The exact posterior of small simulated problems: the reference that filters are measured by.

Needs the extra `benchmarks`: blackjax.
"""
