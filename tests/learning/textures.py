"""Pictures to train on that a test makes itself."""

import cv2
import numpy as np


def textured(seed: int, width: int = 200, height: int = 160) -> np.ndarray:
    """A picture with corners everywhere: rectangles of random shades, slightly blurred."""
    rng = np.random.default_rng(seed)
    picture = np.full((height, width), 128, np.uint8)
    for _ in range(120):
        x, y = rng.integers(width), rng.integers(height)
        size = rng.integers(6, 40, 2)
        cv2.rectangle(picture, (int(x), int(y)), (int(x + size[0]), int(y + size[1])), int(rng.integers(256)), -1)
    return np.asarray(cv2.GaussianBlur(picture, (3, 3), 0))
