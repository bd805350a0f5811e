"""Metrics of results against references, as pure functions."""
