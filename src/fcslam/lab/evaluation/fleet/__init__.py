"""Evaluation of runs against the ground truth or reference relations."""
