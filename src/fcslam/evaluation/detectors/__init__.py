"""Keypoint detectors on scenes with known homographies."""
