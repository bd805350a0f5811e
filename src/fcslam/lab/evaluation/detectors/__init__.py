"""Evaluation of keypoint detectors on scenes with known homographies."""
