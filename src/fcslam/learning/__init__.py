"""Training of the detector: a network that finds keypoints and gives each a descriptor of 256 bits, its code."""
