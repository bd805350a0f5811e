"""fcslam's own recording format, a folder for each robot: reader and writer (docs/reference/recording.md)."""
