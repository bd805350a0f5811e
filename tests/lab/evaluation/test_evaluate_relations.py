"""The relations command's numbers on run folders made here."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from fcslam.errors import InputError
from fcslam.geometry import se2
from fcslam.lab.evaluation.relations import (
    evaluate_relations,
    relation_metrics,
    write_metrics,
)
from fcslam.runs import RobotTrajectory, Run, open_run


@pytest.fixture
def folders(tmp_path):
    """One recording of 90 s, mapped by one robot and by three, whose last one stays in a map of its own."""
    rng = np.random.default_rng(4)
    stamps = 976052857.33753 + np.arange(90.0)
    truth = np.column_stack((rng.uniform(0, 20, (90, 2)), rng.uniform(-3, 3, 90)))
    single = Run({"all": RobotTrajectory("all", 0, stamps, truth)})
    frames = ((0.0, 0.0, 0.0), (0.0, 0.1, 0.0), (5.0, 5.0, 1.0))
    several = Run(
        {
            f"robot_{k}": RobotTrajectory(f"robot_{k}", int(k == 2), stamps[k::3], se2.compose(frames[k], truth[k::3]))
            for k in range(3)
        }
    )
    single.save(tmp_path / "single")
    several.save(tmp_path / "several")
    pairs = np.array([(i, j) for i in range(90) for j in range(i + 1, 90, 7)])
    relations = np.column_stack((stamps[pairs], se2.between(truth[pairs[:, 0]], truth[pairs[:, 1]])))
    lines = [f"{a:.6f} {b:.6f} {x:.9f} {y:.9f} 0 0 0 {theta:.9f}\n" for a, b, x, y, theta in relations]
    (tmp_path / "relations").write_text("".join(lines))
    return tmp_path, pairs


def test_across_robots_counts_by_hand(folders):
    folder, pairs = folders
    errors = evaluate_relations(folder / "several", folder / "relations", across_robots=True)
    asked = [(i % 3, j % 3) for i, j in pairs if i % 3 != j % 3 and j - i > 20]
    assert errors.total == len(asked)
    assert errors.used == sum(2 not in pair for pair in asked)
    np.testing.assert_allclose(errors.translation_m, 0.1, atol=1e-6)
    np.testing.assert_allclose(errors.rotation_deg, 0.0, atol=1e-5)


def test_one_robot_is_measured_by_the_same_relations_as_several(folders):
    folder, _ = folders
    several = evaluate_relations(folder / "several", folder / "relations", across_robots=True)
    single = evaluate_relations(folder / "single", folder / "relations", across_robots=True, parts=folder / "several")
    assert single.total == several.total == single.used
    assert single.translation.maximum < 1e-6


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("single", "no relation between different robots spans more than 20 s"),
        ("empty", "same recording"),
        ("apart", r"apart: none of the \d+ relations .* in different maps"),
    ],
)
def test_runs_without_relations_across_robots(folders, name, message):
    folder, _ = folders
    Run({}).save(folder / "empty")
    run = open_run(folder / "several")
    Run({name: replace(each, map_index=k) for k, (name, each) in enumerate(run.trajectories.items())}).save(
        folder / "apart"
    )
    with pytest.raises(InputError, match=message):
        evaluate_relations(folder / name, folder / "relations", across_robots=True)


def test_metrics_are_written_as_csv_and_json(folders):
    folder, _ = folders
    metrics = relation_metrics(evaluate_relations(folder / "several", folder / "relations", across_robots=True))
    write_metrics(metrics, folder / "table.csv")
    write_metrics(metrics, folder / "table.json")
    with (folder / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    content = json.loads((folder / "table.json").read_text())
    assert [row["name"] for row in rows] == [row["name"] for row in content]
    assert {row["name"]: row["unit"] for row in rows}["rotation_error_mean"] == "deg"
    assert float(rows[0]["value"]) == pytest.approx(content[0]["value"]) == pytest.approx(0.1, abs=1e-6)
    with pytest.raises(InputError, match="cannot be written"):
        write_metrics(metrics, folder / "missing" / "table.csv")
