"""Write docs/reference/settings.md, the reference of all settings, from the settings themselves.

    make docs

A row's effect is the description of the field. The unit stands in brackets at the end of the description, or follows
from the key's suffix. To correct the page, correct the description of the field in the code.
"""

import re
import sys
import types
from collections.abc import Callable, Iterator
from enum import Enum
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

import yaml
from annotated_types import Ge, Gt, Le, Lt, MultipleOf
from pydantic.fields import FieldInfo

from fcslam.cloud.settings import CloudConfig
from fcslam.config import Settings
from fcslam.learning.federated.settings import FederatedSettings, FleetLearningSettings, RobotLearningSettings
from fcslam.learning.settings import TrainingSettings
from fcslam.lidar.frontend import LidarConfig
from fcslam.mission.mission import MissionConfig
from fcslam.robot.frontend import RobotConfig

FOLDER = Path(__file__).parents[1] / "docs" / "reference"

UNITS = {
    "rad_m": "rad/m",
    "per_m": "1/m",
    "per_s": "1/s",
    "per_hour": "1/h",
    "m_s": "m/s",
    "rad_s": "rad/s",
    "m": "m",
    "rad": "rad",
    "s": "s",
    "hz": "Hz",
    "px": "px",
    "mb": "MB",
    "bits": "bit",
    "megabytes": "MB",
}
"""By the suffix of a key; longer ones come first."""

NO_UNIT = "-"
HEADER = ["| key | default | allowed | effect |", "|---|---|---|---|"]

HEAD = """\
# Settings

fcslam works with its defaults. `make docs` writes the page from the code.

## When to change one

| when | key |
|---|---|
| robots are much larger or smaller than 0.7 m | `map.robot_radius_m` |
| the map needs finer or coarser cells, or a huge hall needs more of them | `map.resolution_m`, `map.maximum_cells` |
| beams reach beyond 30 m, or far returns are wrong | `map.usable_range_m` |
| the scanner sees the robot itself (`fcslam info` says so) | `robot.lidar.ignore`, `robot.lidar.footprint` |
| a text log or a program has scans of a scanner that spins | `robot.lidar.scan_duration_s` |
| each robot is to keep a map of its own | `fleet.join_maps` |
| you know where robots start | `fleet.starts`, `fleet.start_sigma` |
| many days in one building need too much memory | `fleet.matcher.most_sessions_nearby`, `fleet.matcher.most_places` |
| a robot is often carried, or often thinks so | `robot.lost.doubted` |
| tags hang in the building | `robot.tags.family`, `robot.tags.size_m` |
| a robot has no camera, or is to send no camera places | `robot.channels` |
| tokens are shared with robots that you trust less | `fleet.claims` |
| you repeat the paper | `--config paper` |

Leave the others: the [results](../results/index.md) were measured with their defaults.

## How to set them

Write the complete default configuration to a file, change it, and give it to a command:

```sh
fcslam tools config > mission.yaml
fcslam map robot1.clf robot2.clf -o runs/building --config mission.yaml
```

- A file needs only the keys that you change. An unknown key is an error that names the nearest known one.
- Every run folder contains the complete configuration of the run, `config.yaml`.
- `fcslam map --config paper` begins with [the paper's settings](../results/paper.md) in place of the defaults. The keys
  of a further `--config FILE` override them.
- In Python, `fcslam.map_recordings(..., config={"map": {"resolution_m": 0.1}})` takes the same keys.

A key path such as `map.resolution_m` stands for nested keys:

```yaml
map:
  resolution_m: 0.1
```

Units are SI; angles are in radians. A setting without unit is a count, a ratio or a choice.
"""

CLOUD = """\
## Cloud and map

Commands that map or serve read these keys with `--config`. The service keeps {cloud} with each mission, so that it can
rebuild the mission from its packets.
"""

ROBOT = """\
## Robots

Commands that map or run a robot read these keys with `--config`.
"""

LIDAR = """\
## LiDAR SLAM on each robot

Commands that map or run a robot read these keys with `--config`.
"""

TRAINING = """\
## Training

`fcslam tools train --config` reads these keys from a YAML file.
"""

FEDERATED = """\
## Federated training

`fcslam tools federate --config` reads these keys from a YAML file. `training` holds the keys of [Training](#training).
"""

LEARNING = """\
## Learning while the fleet maps

`fcslam serve --learn` reads these keys from the file `learning.yaml` in `--data`. `federated` holds the keys of
[Federated training](#federated-training) with the defaults below.
"""

LEARNING_ROBOT = """\
## A robot that learns

`fcslam robot --learn` reads these keys from the file `learning.yaml` in `--state`.
"""


def cloud_page() -> str:
    """How to set settings, and those of the cloud and the map."""
    cloud = CLOUD.format(cloud=", ".join(f"`{key}`" for key in CloudConfig.model_fields))
    return "\n".join([HEAD, cloud, table(MissionConfig(), documented=(RobotConfig,))])


def robot_page() -> str:
    """The settings of the robots, without those of LiDAR SLAM."""
    return "\n".join([ROBOT, table(MissionConfig().robot, "robot.", documented=(LidarConfig,))])


def lidar_page() -> str:
    """The settings of LiDAR SLAM on a robot."""
    return "\n".join([LIDAR, table(MissionConfig().robot.lidar, "robot.lidar.")])


def training_page() -> str:
    """The settings of training."""
    federated = table(FederatedSettings(), documented=(TrainingSettings,))
    live = table(FleetLearningSettings(), documented=(FederatedSettings,))
    rounds, defaults = FleetLearningSettings().federated, FederatedSettings()
    changed = [
        row(f"{prefix}{key}", field, getattr(mine, key))
        for prefix, mine, other in (
            ("federated.", rounds, defaults),
            ("federated.training.", rounds.training, defaults.training),
        )
        for key, field in type(mine).model_fields.items()
        if getattr(mine, key) != getattr(other, key) and not isinstance(getattr(mine, key), Settings)
    ]
    parts = [TRAINING, table(TrainingSettings()), FEDERATED, federated, LEARNING, live, *HEADER, *changed, ""]
    return "\n".join([*parts, LEARNING_ROBOT, table(RobotLearningSettings())])


PAGES: dict[Path, Callable[[], str]] = {
    FOLDER / "settings.md": lambda: "\n".join([cloud_page(), robot_page(), lidar_page(), training_page()]),
}


def table(settings: Settings, path: str = "", documented: tuple[type[Settings], ...] = ()) -> str:
    """The keys of ``settings`` and of those nested in them, but the ``documented`` ones."""
    return "\n".join([*HEADER, *keys_of(settings, path, documented), ""])


def keys_of(settings: Settings, path: str, documented: tuple[type[Settings], ...]) -> Iterator[str]:
    """The line of each key; nested settings follow the plain keys."""
    nested = []
    for key, field in type(settings).model_fields.items():
        value = getattr(settings, key)
        if not isinstance(value, Settings):
            yield row(f"{path}{key}", field, value)
        elif not isinstance(value, documented):
            nested.append((value, f"{path}{key}."))
    for value, inner in nested:
        yield from keys_of(value, inner, documented)


def row(path: str, field: FieldInfo, value: Any) -> str:
    """One line of a table."""
    effect, stated = split_unit(sentence(field.description))
    of_unit = stated or unit(path)
    default = f"`{flow(value)}`" if of_unit == "-" else f"`{flow(value)}` {of_unit}"
    cells = [f"`{path}`", default, allowed(field), effect]
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def split_unit(effect: str) -> tuple[str, str]:
    """A sentence without the unit in brackets at its end, and this unit; an empty one if it states none."""
    stated = re.search(r" \[([^],]+)\]\.$", effect)
    return (effect[: stated.start()] + ".", stated[1]) if stated else (effect, "")


def unit(path: str) -> str:
    """The unit by the suffix of the key."""
    key = path.rpartition(".")[2].lower()
    return next((name for suffix, name in UNITS.items() if key == suffix or key.endswith(f"_{suffix}")), NO_UNIT)


def allowed(field: FieldInfo) -> str:
    """Choices or bounds."""
    choices = list(choices_of(field.annotation))
    if choices:
        return ", ".join(f"`{flow(choice)}`" for choice in choices)
    bounds = []
    for bound in field.metadata:
        match bound:
            case Ge(value):
                bounds.append(f">= {value:g}")
            case Gt(value):
                bounds.append(f"> {value:g}")
            case Le(value):
                bounds.append(f"<= {value:g}")
            case Lt(value):
                bounds.append(f"< {value:g}")
            case MultipleOf(value):
                bounds.append(f"multiple of {value}")
    if type(None) in get_args(field.annotation):
        bounds.append("`null`")
    return ", ".join(bounds)


def choices_of(annotation: Any) -> Iterator[Any]:
    """Values of an enumeration, of literals or of a truth value, alone or in a tuple."""
    if annotation is bool:
        yield from (True, False)
    elif isinstance(annotation, type) and issubclass(annotation, Enum):
        yield from (member.value for member in annotation)
    elif get_origin(annotation) is Literal:
        yield from get_args(annotation)
    elif get_origin(annotation) in (tuple, Union, types.UnionType):
        for part in get_args(annotation):
            yield from choices_of(part)


def flow(value: Any) -> str:
    """A value as YAML on one line."""
    if isinstance(value, tuple):
        value = [item.value if isinstance(item, Enum) else item for item in value]
    elif isinstance(value, Enum):
        value = value.value
    elif isinstance(value, Path):
        value = str(value)
    text: str = yaml.safe_dump(value, default_flow_style=True, width=10_000)
    return text.removesuffix("\n").removesuffix("\n...")


def sentence(description: str | None) -> str:
    """A description with a capital letter and a full stop."""
    if not description:
        raise SystemExit("a setting has no description")
    return f"{description[0].upper()}{description[1:]}" + ("" if description.endswith(".") else ".")


def main() -> int:
    """Write the pages."""
    for path, page in PAGES.items():
        path.write_text(page(), encoding="utf-8")
        print(f"{path}: {page().count(chr(10) + '| `')} settings")
    return 0


if __name__ == "__main__":
    sys.exit(main())
