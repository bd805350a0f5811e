"""Place recognition on images and LiDAR recordings."""
