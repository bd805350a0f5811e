"""The paper's network and losses beside ours: trainings with the same images, labels and processor time.

    FCSLAM_DATA=/path/to/data python benchmarks/paper_networks.py --training networks

The encoders are that of the paper (vgg) and the default one (light). The losses are eqs. (1)-(3) alone with the hardest
negative (paper) or with all of them (paper-all), as the paper does not say which; and all of ours but distillation.
The paper does not say how its detector learns keypoints: all have the cross entropy, on the same labels, which are the
keypoints of the detector that comes with fcslam and Harris's corners. Each training takes the same processor time on
one thread; with the paper's losses, --collapsing-minutes may be fewer, as its codes collapse soon. The folder
--training keeps what is done; the same command continues.

Validation: pairs of held-out images, as at the end of `fcslam tools train`. `benchmarks/homography.py` evaluates the
networks on other scenes.
"""

import csv
from collections.abc import Iterable, Iterator
from pathlib import Path

import common
import numpy as np
import yaml

from fcslam.features.detector import OnnxConfig, OnnxDetector
from fcslam.learning.images import find_images, is_usable, read_image

IMAGES = ("bsds500", "camvid", "coco_subset", "kodak24", "openimages_doors", "sun_hays80", "urban100")
"""Folders of images; none holds a scene that a detector is evaluated on."""
STEP_S = {"vgg": 1.6, "light": 0.47}
"""Seconds of a step on one core."""
PAPER = {"margin": 0.0, "rounding": 1e-6, "contrastive": 0.0, "distillation": 0.0, "balance": 0.0, "agreement": 0.0}
LOSSES = {
    "paper": PAPER,
    "paper-all": {**PAPER, "negatives": "all"},
    "ours": {"distillation": 0.0},
}
"""Eqs. (1)-(3) alone, with the hardest negative or with all of them, as the paper does not say which; and ours."""
COLUMNS = {
    "encoder": "",
    "losses": "",
    "steps": "d",
    "CPU, min": ".1f",
    "measure on held-out images": "",
    "value": ".3f",
}


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--training", type=Path, required=True, help="folder of the trainings")
    parser.add_argument("--minutes", type=float, default=25.0, help="of one core for each training")
    parser.add_argument("--collapsing-minutes", type=float, help="of those with the paper's losses [as the others]")
    parser.add_argument("--encoders", nargs="+", choices=STEP_S, default=list(STEP_S), help="encoders")
    parser.add_argument("--losses", nargs="+", choices=LOSSES, default=list(LOSSES), help="losses")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__ or "", chosen)
    folder = common.recordings(*IMAGES, kind="vision")
    roots = [folder / name for name in IMAGES]
    teacher = chosen.training / "teacher"
    label(roots, teacher)
    kept = common.Kept(chosen.training / "kept.jsonl")
    rows: list[tuple] = []
    for encoder in chosen.encoders:
        for losses in chosen.losses:
            minutes = chosen.minutes if losses == "ours" else chosen.collapsing_minutes or chosen.minutes
            key = (encoder, losses, minutes)
            rows += kept.rows(key, lambda key=key: train(roots, teacher, chosen.training, *key))
    report.table("Trainings", COLUMNS, rows)
    report.write()


def label(roots: Iterable[Path], teacher: Path) -> None:
    """Write the keypoints of the bundled detector for each image, as `fcslam tools train --teacher` reads them."""
    detector = OnnxDetector(OnnxConfig())
    for file in find_images(list(roots)):
        target = teacher / f"{file.name}.npz"
        image = None if target.exists() else read_image(file.path)
        if image is None or not is_usable(image):
            continue
        found = detector.detect(image)
        bits = np.unpackbits(found.descriptors, axis=1).astype(np.float16)
        target.parent.mkdir(parents=True, exist_ok=True)
        np.savez(target, keypoints=found.keypoints_px, scores=found.scores, descriptors=bits)


def train(
    roots: Iterable[Path], teacher: Path, folder: Path, encoder: str, losses: str, minutes: float
) -> Iterator[tuple]:
    """One training; yields a row for each measure of its last validation."""
    run = folder / f"{encoder}-{losses}"
    labels = run / "labels"
    if not labels.exists():  # those of all trainings are equal
        run.mkdir(parents=True, exist_ok=True)
        (folder / "labels").mkdir(exist_ok=True)
        labels.symlink_to((folder / "labels").resolve())
    steps = round(60.0 * minutes / STEP_S[encoder])
    settings = folder / f"{run.name}.yaml"
    settings.write_text(yaml.safe_dump({"loss": LOSSES[losses]}), encoding="utf-8")
    cost = common.run_fcslam(
        "tools", "train", *roots, "--config", settings, "--config", f"encoder={encoder}", "--config", f"steps={steps}",
        "--teacher", teacher, "--output", run, environment={"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""},
    )  # fmt: skip
    last: dict[str, float] = {}
    with (run / "joint" / "progress.csv").open(encoding="utf-8") as file:
        for line in csv.DictReader(file):
            last[line["name"]] = float(line["value"])
    for name, value in last.items():
        yield encoder, losses, steps, cost.cpu_s / 60.0, name, value


if __name__ == "__main__":
    main()
