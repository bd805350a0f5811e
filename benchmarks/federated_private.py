"""Federated training whose robots keep the detector head to themselves, beside the same training of all layers.

    FCSLAM_DATA=/path/to/data python benchmarks/federated_private.py --study FOLDER

Needs `fcslam[federated]` and `fcslam[sim]`. FOLDER holds all that is trained and measured; the same command goes on
where it was interrupted. Robots, images, first detector and settings are those of federated.py, but for a tenth of the
rounds, a quarter of the pairs and one seed. Central training takes as many steps as all robots together.

Private robots share every layer but those of the keypoints (`private` in the settings). So each has a network of its
own, and a pair of views is measured with one of them, in turns. Between: the first view is seen by another robot's
network, as when two robots find the same place. Gaps are in points, with 95 % by paired bootstrap over pairs.
"""

from pathlib import Path

import common
from federated import AT_HOME, IMAGES, PUBLIC, STEPS, TRAINED, TRAINING, home_rows, initial
from training_fleet import GAPS, TITLES, VISION, compare, gap_row, robots, run

HEAD = ("body.context_quarter", "body.point_head", "body.refine")
ARMS = {"together": {}, "private": {"settings": {"private": HEAD}}}
COMPARED = ("start", "central", *ARMS)
BETWEEN = {"mma_3px_between": "MMA at 3 px between two robots, %"}
ROUNDS, SEEDS, PAIRS = 20, 1, 500


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--study", type=Path, help="folder of the study; the same one resumes")
    chosen = parser.parse_args()
    if chosen.study is None:
        print("skipped: takes 15 minutes; name a folder by --study")
        return
    folder: Path = chosen.study.resolve()
    vision = common.recordings(*VISION.values(), PUBLIC, kind="vision")
    folder.mkdir(parents=True, exist_ok=True)
    content = {
        "federated": {"rounds": ROUNDS, "local_steps": STEPS, "training": TRAINING},
        "arms": ARMS,
        "seeds": SEEDS,
        "local_seeds": 0,
        "pairs": PAIRS,
        "images": IMAGES,
        "trained": TRAINED,
        "start": initial(vision, folder),
    }
    findings = run(robots(vision, folder), folder / "private", content)
    report = common.Report(__file__, __doc__, chosen)
    report.say(
        f"{ROUNDS} rounds of {STEPS} steps of {TRAINING['pairs']} pairs a robot; central {ROUNDS * STEPS * 5} steps. "
        f"{len(findings.owners)} pairs."
    )
    below = compare(findings, "together")
    for measure, title in (TITLES | BETWEEN).items():
        report.table(f"{title}; gap to together", GAPS, [gap_row(below[measure, arm]) for arm in COMPARED])
    report.table("At home and where other robots are", AT_HOME, list(home_rows(findings, ["private"])))
    report.write()


if __name__ == "__main__":
    main()
