"""fcslam: several robots map one building together."""

__version__ = "0.1.0"
