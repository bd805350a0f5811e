"""Can the bundled detector find its keypoints more exactly? Its keypoint layers train further on photographs.

    python benchmarks/keypoint_layers.py --fleets FOLDER [--keep ROWS.jsonl] [--steps 1500] [--networks FOLDER]

Only the layers that turn features into keypoints train; the codes of an image stay as they are. A step has four pairs
of views of photographs under random homographies and light (BSDS500, COCO, SUN and Open Images; none is measured on).
Every arm has the cross entropy to the bundled network's own probabilities, and beside it:

- agreement: the keypoint maps of both views agree in windows (`agreement_loss` in `learning/losses.py`)
- localization: keypoints of both views that are mutual nearest neighbours within 2.5 px lie, by the parabola through
  each peak, at the same point (`localization_loss` in `benchmarks/subpixel_loss.py`)
- both

Measured on 25 pairs of photographs of other places (corrected, NMS 8 px; needs FCSLAM_DATA), and in the unseen
buildings of `benchmarks/closure_learning.py`, which records them into FOLDER: camera alone, robots in different light.
Intervals are 95 %, by bootstrap over buildings, of the difference to the bundled detector. --keep resumes by arm and
building; --networks keeps the trained networks. An arm takes some ten minutes of one core.
"""

from functools import partial
from pathlib import Path

import common
import numpy as np
import torch
from closure_learning import (
    COLUMNS,
    FORGETTING,
    ROBOTS,
    SCENES,
    TEST,
    UNSEEN,
    building_row,
    gains,
    kept_networks,
    means,
    photograph_rows,
    recorded,
)
from subpixel_loss import localization_loss
from torch import Tensor

from fcslam.features.detector import BUNDLED_NETWORK
from fcslam.learning.batches import draw_batch
from fcslam.learning.export import export_onnx
from fcslam.learning.federated.initial_weights import prepare_initial_weights
from fcslam.learning.federated.networks import weights_to_network
from fcslam.learning.images import find_images, read_image
from fcslam.learning.labels import Labels
from fcslam.learning.local_training import LocalTrainingPlan, train_layers
from fcslam.learning.losses import agreement_loss, detector_loss
from fcslam.learning.network import cell_probabilities
from fcslam.learning.objective import grid_shift, shift_grid, views_aligned
from fcslam.learning.pairs import TrainingExample
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.trainer import ExecutionOptions

PHOTOGRAPHS = ("bsds500", "coco_subset", "sun_hays80", "openimages_doors")
ARMS = {"bundled": (), "agreement": ("agreement",), "localization": ("localization",),
        "both": ("agreement", "localization")}  # fmt: skip
UNLABELLED = Labels(np.zeros((1, 2), np.float32), np.ones(1, np.float32))
"""No arm uses labels."""


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--fleets", type=Path, required=True, help="folder of recordings; those missing are made there")
    parser.add_argument("--test", nargs="+", type=int, default=TEST, help="seeds of the buildings")
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS), help="which networks")
    parser.add_argument("--steps", type=int, default=1500, help="of training")
    parser.add_argument("--keep", type=Path, help="file that keeps finished arms; the same one resumes")
    parser.add_argument("--networks", type=Path, default=Path("keypoint-layers"), help="folder of the networks")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    common.recordings(*SCENES, kind="vision")
    chosen.networks.mkdir(parents=True, exist_ok=True)
    kept = common.Kept(chosen.keep)
    report = common.Report(__file__, __doc__ or "", chosen)
    settings = TrainingSettings(steps=chosen.steps, pairs=4, side_px=192, learning_rate=1e-3)
    rows: list[tuple] = []
    photographs: list[tuple] = []
    for arm in (arm for arm in ARMS if arm in chosen.arms):
        place = chosen.networks / f"{arm}-{chosen.steps}-{common.commit()}"
        networks = kept_networks(place, partial(trained, arm, settings))
        photographs += kept.rows((arm, chosen.steps, "photographs"), partial(photograph_rows, arm, 1, networks))
        for seed in chosen.test:
            folder = recorded(seed, len(ROBOTS), chosen.fleets)
            measure = partial(building_row, arm, 1, UNSEEN, folder, ROBOTS, networks)
            rows += kept.rows((arm, chosen.steps, seed), measure)
    report.table(f"Above the bundled detector, {UNSEEN}", COLUMNS, gains(rows, UNSEEN))
    report.table(f"Means, {UNSEEN}", COLUMNS, means(rows, UNSEEN))
    report.table("Photographs of other places", FORGETTING, photographs)
    report.write()


def trained(arm: str, settings: TrainingSettings, folder: Path) -> list[Path | None]:
    """The network of an arm; None for the bundled one."""
    if arm == "bundled":
        return [None]
    vision = common.recordings(*PHOTOGRAPHS, kind="vision")
    files = find_images([vision / name for name in PHOTOGRAPHS])
    examples = [TrainingExample(image, UNLABELLED) for file in files if (image := read_image(file.path)) is not None]
    weights = prepare_initial_weights(BUNDLED_NETWORK, folder, settings, ExecutionOptions(), lambda *_: None)
    network, before = (weights_to_network(weights, settings.encoder) for _ in range(2))

    def losses_of(step: int) -> tuple[Tensor, dict[str, Tensor]]:
        batch = draw_batch(examples, settings, step)
        with torch.no_grad():
            wanted = cell_probabilities(before(batch.images).point_logits)
        logits = network(batch.images).point_logits
        shift = grid_shift(settings.encoder, settings.seed, step)
        parts = {"initial": detector_loss(*shift_grid((logits, wanted, batch.seen), shift))}
        if "agreement" in ARMS[arm]:
            parts["agreement"] = agreement_loss(*views_aligned(logits.sigmoid(), batch))
        if "localization" in ARMS[arm]:
            parts["localization"] = localization_loss(logits.sigmoid(), batch.homographies)
        return torch.stack(list(parts.values())).sum(), parts

    train_layers(network, network.body.point_layers, losses_of, LocalTrainingPlan(settings, 0, settings.steps))
    export_onnx(network, folder / "0.onnx")
    return [folder / "0.onnx"]


if __name__ == "__main__":
    main()
