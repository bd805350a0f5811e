"""Training of the detector: a network that finds keypoints and gives each a code of 256 bits."""
