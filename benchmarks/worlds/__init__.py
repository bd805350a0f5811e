"""Worlds that benchmarks simulate beside the buildings of fcslam."""
