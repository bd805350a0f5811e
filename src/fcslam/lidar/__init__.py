"""The robot's LiDAR front end: scan matching, submaps, keyscans and local loop closing (Karto class)."""
