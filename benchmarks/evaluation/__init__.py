"""Evaluation of place recognition on images and LiDAR recordings."""
