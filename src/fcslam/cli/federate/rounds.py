"""A round of federated training in one line."""

from collections.abc import Mapping


def round_line(row: Mapping[str, str], rounds: int) -> str:
    """The line of a row of ``rounds.csv``: robots, figures, traffic and whether the new detector is released."""
    released, returned, judged = row["released"] == "1", row["returned"] == "1", row["score"] != "nan"
    outcome = "back to the best" if returned else "not released" if judged else "not judged"
    shown = {"detector": "loss_detector", "contrastive": "loss_contrastive", "repeatability": "repeatability",
             "MMA": "mma_3px"}  # fmt: skip
    parts = [
        f"round {row['round']}/{rounds}",
        f"{len(row['robots'].split(' | '))} robots",
        *(f"{name} {float(row[column]):.3f}" for name, column in shown.items() if row.get(column)),
        f"down {float(row['bytes_down']) / 1e6:.1f} MB, up {float(row['bytes_up']) / 1e6:.1f} MB",
        f"released {row['version']}" if released else outcome,
        *([f"without {row['left_out']}"] if row["left_out"] else []),
    ]
    return "  ".join(parts)
