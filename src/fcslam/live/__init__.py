"""A live robot: scans in, poses in the map out, as they happen. ``robot.py`` holds the public class ``Robot``."""
