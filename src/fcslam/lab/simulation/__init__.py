"""Simulated fleets with ground truth."""
