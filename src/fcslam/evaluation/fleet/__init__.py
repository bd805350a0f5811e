"""Runs against the ground truth, and pictures of them."""
