"""Rooms of 3D LiDARs: a robot's motion in six degrees of freedom, its local maps, and closures between them."""
