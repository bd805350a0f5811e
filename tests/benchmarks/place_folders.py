"""Small sets of places, drawn."""

import cv2
import numpy as np


def texture(seed, shape=(150, 200)):
    """A picture with corners everywhere, like no other."""
    noise = np.random.default_rng(seed).uniform(0, 255, (60, 60)).astype(np.float32)
    large = cv2.resize(noise, None, fx=6, fy=6, interpolation=cv2.INTER_NEAREST)
    return cv2.GaussianBlur(large, (0, 0), 1.0)[: shape[0], : shape[1]].astype(np.uint8)


def write(path, picture):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), picture)


def again(seed, shift=4):
    """The same place from a little further on."""
    return texture(seed, (150 + shift, 200 + shift))[shift:, shift:]


def generic(folder, places=6):
    """Each query shows the gallery's place of its number again; the last place is asked for by nobody."""
    lines = ["query,gallery,relation"]
    for k in range(places):
        write(folder / "gallery" / f"{k}.png", texture(k))
        if k < places - 1:
            write(folder / "queries" / f"q{k}.png", again(k))
            lines.append(f"q{k}.png,{k}.png,match")
    lines.append(f"q0.png,{places - 1}.png,ignored")
    (folder / "matches.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


def tour(folder, images=50, first_again=30):
    """A walk that comes back to its beginning: image ``first_again`` + k shows the place of image k."""
    lines = ["# i j inliers"]
    for k in range(images):
        write(folder / f"{k + 1:03d}.png", again(k - first_again) if k >= first_again else texture(k))
        if k >= first_again:
            lines.append(f"{k - first_again + 1} {k + 1} 30")
    (folder / "loop_pairs.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


def tower(folder):
    """Two floors, three areas each, clips of 20 frames of which every tenth is a query; no images."""
    lines = ["image,label,split,area,section,floor_range"]
    for floor in ("floor1", "floor2"):
        for area in ("stairs", "hall", "elevator"):
            for frame in range(1, 21):
                split = "query" if frame % 10 == 0 else "gallery"
                lines.append(f"{floor}/{floor}_{area}_frame_{frame:06d}.jpg,{floor},{split},{area},x,y")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "dataset.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder
