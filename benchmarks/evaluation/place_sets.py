"""Sets of images with ground truth of which images show the same place.

The files in a folder decide how it is read:

- ``dataset.csv`` (image, label, split, area; frames of clips ``<clip>_frame_<number>``): floors of a tower that look
  the same. A match is the same clip, at most 4 frame numbers apart; different is another area of the same floor, or the
  same clip more than 12 apart. A second question, ``near``: different is another floor.
- ``loop_pairs.txt`` (i j ..., numbers of images): one tour, online. A match is a listed pair; unlisted ones within 8
  images of it at both ends are ignored, all others are different.
- ``associations.txt`` and ``groundtruth.txt``: a TUM RGB-D sequence (Sturm et al. 2012), online. A match is an overlap
  of the views by depth and pose of more than 0.5, different is less than 0.1.
- ``simulation.yaml``: a fleet with cameras of ``fcslam tools simulate``. Each robot's images, a metre or half a
  radian apart, are queries for those of the robots before it. Overlap is that of the walls that the LiDARs met in the
  cameras' views. The limits are those of TUM's sequences.
- ``matches.csv`` (query, gallery, relation) with folders ``queries`` and ``gallery``: relation is ``match`` or
  ``ignored``; what is not listed is different.

Online: every image queries the earlier images, except the most recent ones.
"""

import csv
import io
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from fcslam.errors import InputError
from fcslam.untrusted import read_text

from .fleet_views import read_fleet_views
from .retrieval import Pairs, PairTruth, excluding_recent
from .view_overlap import OTHER_OVERLAP, SAME_OVERLAP, read_sequence, view_overlap

LABELLED: Final = "dataset.csv"
FLEET: Final = "simulation.yaml"
SAME_CLIP_FRAMES: Final = 4
OTHER_CLIP_FRAMES: Final = 12
NEAR_PAIR: Final = 8
TOUR_GAP: Final = 20
"""Images of a tour that are not retrieved, because they are just before the query."""
SEQUENCE_GAP_S: Final = 3.0

_FRAME = re.compile(r"(.+)_frame_(\d+)")


@dataclass(frozen=True, slots=True)
class PlaceSet:
    """Queries (rows), gallery (columns), and their ground truth."""

    name: str
    queries: tuple[Path, ...]
    gallery: tuple[Path, ...]
    admitted: Pairs
    """Shape (Q, G): whether the query may retrieve the place."""
    questions: Mapping[str, PairTruth]
    """Ground truth by name; pairs that are not admitted are ignored."""

    @property
    def is_online(self) -> bool:
        """Whether queries and gallery are one stream in the order of time, and each image queries the earlier ones."""
        return self.queries == self.gallery and not np.triu(self.admitted).any()


def read_place_set(folder: Path, labels: Collection[str] = (), every_image: bool = False) -> PlaceSet:
    """Read the set in a folder; ``labels`` selects images of a set with labels.

    ``every_image``: each image of a set with labels queries all others, where those of one split query the others
    else. Then a pair of images of a floor's lift, or of its lift and stairs, is not different: the clips of a lift turn
    round in one lobby and look along the way to the stairs.

    Raises:
        InputError: the folder has no known set, its files are inconsistent, or no image has these labels.
        SourceError: a robot's recording cannot be read.
    """
    readers: dict[str, Callable[[], PlaceSet]] = {
        LABELLED: lambda: _read_tower(folder, labels, every_image),
        "loop_pairs.txt": lambda: _read_tour(folder),
        "associations.txt": lambda: _read_sequence(folder),
        FLEET: lambda: _read_fleet(folder),
        "matches.csv": lambda: _read_generic(folder),
    }
    kind = next((name for name in readers if (folder / name).is_file()), None)
    if kind is None:
        raise InputError(f"{folder}: no set of places; it needs one of {', '.join(readers)}")
    if labels and kind != LABELLED:
        raise InputError(f"{folder}: its images have no labels; leave --label out")
    try:
        found = readers[kind]()
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{folder / kind}: cannot be read as a set of places ({error!r})") from error
    if not (found.queries and found.gallery):
        raise InputError(f"{folder}: no queries or no gallery; is the folder complete, are the labels right?")
    return found


def all_images(place_set: PlaceSet) -> tuple[Path, ...]:
    """All images once: the gallery, then queries that are not in it."""
    return tuple(dict.fromkeys((*place_set.gallery, *place_set.queries)))


def _stream(folder: Path, images: tuple[Path, ...], admitted: Pairs, question: str, truth: PairTruth) -> PlaceSet:
    """An online set; pairs that are not admitted are ignored."""
    asked = PairTruth(truth.matches & admitted, truth.different & admitted)
    return PlaceSet(folder.resolve().name, images, images, admitted, {question: asked})


def _read_tower(folder: Path, labels: Collection[str], every_image: bool) -> PlaceSet:
    with io.StringIO(read_text(folder / LABELLED), newline="") as file:
        rows = [row for row in csv.DictReader(file) if not labels or row["label"] in labels]
    frames = [_FRAME.fullmatch(str(Path(row["image"]).with_suffix(""))) for row in rows]
    wrong = [row["image"] for row, frame in zip(rows, frames, strict=True) if frame is None]
    if wrong:
        raise InputError(f"{folder}: {wrong[0]} is not a <clip>_frame_<number>")
    clips = np.array([frame[1] for frame in frames if frame])
    numbers = np.array([int(frame[2]) for frame in frames if frame])
    floors, areas = (np.array([row[key] for row in rows]) for key in ("label", "area"))
    q, g = (np.flatnonzero([every_image or row["split"] == split for row in rows]) for split in ("query", "gallery"))

    same_clip = clips[q][:, None] == clips[g]
    apart = np.abs(numbers[q][:, None] - numbers[g])
    same_floor, same_area = floors[q][:, None] == floors[g], areas[q][:, None] == areas[g]
    admitted = q[:, None] != g
    matches = same_clip & (apart <= SAME_CLIP_FRAMES) & admitted
    lift, beside = areas == "elevator", np.isin(areas, ("elevator", "stairs"))
    one_lobby = every_image & same_floor & ((lift[q][:, None] & beside[g]) | (beside[q][:, None] & lift[g]))
    within = ((same_floor & ~same_area) | (same_clip & (apart > OTHER_CLIP_FRAMES))) & ~one_lobby
    paths = [folder / row["image"] for row in rows]
    return PlaceSet(
        folder.resolve().name + (", every image" if every_image else ""),
        tuple(paths[i] for i in q),
        tuple(paths[i] for i in g),
        admitted,
        {"within a floor": PairTruth(matches, within), "near": PairTruth(matches, ~same_floor)},
    )


def _read_tour(folder: Path) -> PlaceSet:
    images = {int(path.stem): path for path in sorted(folder.iterdir()) if path.stem.isdecimal()}
    numbers = sorted(images)
    pairs = np.loadtxt(io.StringIO(read_text(folder / "loop_pairs.txt")), dtype=np.int64, usecols=(0, 1), ndmin=2)
    missing = sorted(set(pairs.ravel()) - set(numbers))
    if missing:
        raise InputError(f"{folder}: loop_pairs.txt names image {missing[0]}, which is not there")
    earlier, later = np.searchsorted(numbers, np.sort(pairs, axis=1)).T
    count = len(numbers)
    matches, near = np.zeros((count, count), np.bool_), np.zeros((count, count), np.bool_)
    matches[later, earlier] = True
    for i, j in zip(earlier, later, strict=True):
        near[max(0, j - NEAR_PAIR) : j + NEAR_PAIR + 1, max(0, i - NEAR_PAIR) : i + NEAR_PAIR + 1] = True
    admitted = excluding_recent(np.arange(count), TOUR_GAP)
    paths = tuple(images[number] for number in numbers)
    return _stream(folder, paths, admitted, "loops", PairTruth(matches, ~near))


def _read_sequence(folder: Path) -> PlaceSet:
    sequence = read_sequence(folder)
    overlap = view_overlap(sequence.depths_m, sequence.T_world_camera, sequence.camera)
    admitted = excluding_recent(sequence.stamps, SEQUENCE_GAP_S)
    truth = PairTruth(overlap > SAME_OVERLAP, overlap < OTHER_OVERLAP)
    return _stream(folder, sequence.images, admitted, "overlap", truth)


def _read_fleet(folder: Path) -> PlaceSet:
    views = read_fleet_views(folder)
    q, g = np.flatnonzero(views.robots > 0), np.flatnonzero(views.robots < views.robots.max())
    admitted = views.robots[q][:, None] > views.robots[g]
    overlap = views.overlap[np.ix_(q, g)]
    truth = PairTruth(admitted & (overlap > SAME_OVERLAP), admitted & (overlap < OTHER_OVERLAP))
    queries, gallery = (tuple(views.images[i] for i in rows) for rows in (q, g))
    return PlaceSet(folder.resolve().name, queries, gallery, admitted, {"overlap": truth})


def _read_generic(folder: Path) -> PlaceSet:
    queries, gallery = (
        tuple(sorted(path for path in (folder / name).rglob("*") if path.is_file())) for name in ("queries", "gallery")
    )
    rows, columns = (
        {path.relative_to(folder / name).as_posix(): k for k, path in enumerate(paths)}
        for name, paths in (("queries", queries), ("gallery", gallery))
    )
    matches, ignored = (np.zeros((len(queries), len(gallery)), np.bool_) for _ in range(2))
    with io.StringIO(read_text(folder / "matches.csv"), newline="") as file:
        for line in csv.DictReader(file):
            relation = line["relation"]
            if relation not in ("match", "ignored"):
                raise InputError(f"{folder}: relation '{relation}' in matches.csv; give match or ignored")
            if line["query"] not in rows or line["gallery"] not in columns:
                raise InputError(f"{folder}: matches.csv names {line['query']}, {line['gallery']}: not both there")
            (matches if relation == "match" else ignored)[rows[line["query"]], columns[line["gallery"]]] = True
    truth = PairTruth(matches & ~ignored, ~matches & ~ignored)
    return PlaceSet(folder.resolve().name, queries, gallery, np.ones_like(matches), {"matches": truth})
