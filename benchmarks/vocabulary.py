"""What a place costs as the index grows from 100 to 100,000 places: time to take one in and to ask for it, and memory.

    FCSLAM_DATA=/path/to/data python benchmarks/vocabulary.py

Places have 300 descriptors. The first ones are ORB's on the images of ie_tower, bsds500, coco_subset, urban100,
sun_hays80, kodak24 and camvid, in random order; after them come mixtures: of three quarters of one image's
descriptors and a quarter of another's, every bit flipped with a chance of 1 in 16. Each method is a process of its
own on one core; times are CPU time of it alone. "insert" is the mean of all places since the row before, with every
split, renewal and growing of arrays, "slowest" the longest of these. "query" is the mean of 50 for the 20 most similar
to a further mixture. "memory" is the growth of the resident set, "peak" its maximum, which arrays that move reach for
a moment. Brute force compares every descriptor with every other (at most 48 bits); the static tree is as
DBoW's, 10 children and 5 levels, trained on the first 300 places, scored by eq. (4).
"""

import itertools
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import common

IMAGES = ("ie_tower", "bsds500", "coco_subset", "urban100", "sun_hays80", "kodak24", "camvid")
DESCRIPTORS = 300
MARKS = (100, 300, 1_000, 3_000, 10_000, 30_000, 100_000)
MOST = {"incremental": 100_000, "static": 30_000, "brute force": 3_000}
"""Places of each method at most."""
ASKED = 50
FLIP_HALVINGS = 4
"""A bit flips with a chance of a half to this power."""
SEED = 1
COSTS = {"index": "", "places": ",", "insert, ms": ".2f", "slowest, ms": ".0f", "query, ms": ".2f",
         "insert + query, ms": ".2f", "memory a place, kB": ".1f", "peak, MB": ".0f", "words": ","}  # fmt: skip
WORDS = {"index": "", "places": ",", "1,000 descriptors to words, ms": ".3f"}


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--most", type=int, default=MARKS[-1], help="places of the largest index")
    chosen = parser.parse_args()
    folder = common.recordings(*IMAGES, kind="vision")
    report = common.Report(__file__, __doc__, chosen)
    with tempfile.TemporaryDirectory() as place:
        real = Path(place) / "real.npy"
        alone(describe_images, folder, real)
        measured = [alone(grow, method, real, chosen.most) for method in MOST]
    rows = [row for costs, _ in measured for row in costs]
    report.table("Cost of a place", COSTS, rows)
    grown = [row for row in measured[0][0] if row[1] in (10_000, 100_000)]
    if len(grown) == 2:
        ratio = grown[1][5] / grown[0][5]
        report.say(f"Incremental, insert + query from 10,000 to 100,000 places: {ratio:.2f} times the time.")
    report.table("Words", WORDS, [words for _, words in measured if words])
    report.picture("Cost of a place", draw(rows))
    report.write()


def alone(case: Callable[..., Any], *arguments: object) -> Any:
    """The result of ``case`` in a fresh process on one core."""
    with get_context("spawn").Pool(1, one_thread) as pool:
        return pool.apply(case, arguments)


def one_thread() -> None:
    os.environ["OMP_NUM_THREADS"] = os.environ["NUMBA_NUM_THREADS"] = "1"


def describe_images(folder: Path, target: Path) -> None:
    """Write the descriptors (P, 300, 32) of all images that have so many."""
    import numpy as np

    from fcslam.features.classical import Orb
    from fcslam.features.files import read_grey

    orb = Orb(most_features=DESCRIPTORS)
    paths = sorted(path for name in IMAGES for path in (folder / name).rglob("*.jpg"))
    described = [orb.detect(read_grey(path)).descriptors[:DESCRIPTORS] for path in paths]
    kept = np.stack([codes for codes in described if len(codes) == DESCRIPTORS])
    np.save(target, np.random.default_rng(SEED).permutation(kept))


def places(real: Any, rng: Any) -> Iterator[Any]:
    """Descriptors (300, 32) of one place after the other: the images, then mixtures without end."""
    import numpy as np

    yield from real
    while True:
        one, other = rng.integers(0, len(real), 2)
        mixed = real[one].copy()
        replaced = rng.choice(DESCRIPTORS, DESCRIPTORS // 4, replace=False)
        mixed[replaced] = real[other][replaced]
        flips = rng.integers(0, 256, (FLIP_HALVINGS, *mixed.shape), dtype=np.uint8)
        yield mixed ^ np.bitwise_and.reduce(flips)


def grow(method: str, real: Path, most: int) -> tuple[list[tuple], tuple | None]:
    """Rows of ``COSTS`` for one method, and of ``WORDS`` if it has words."""
    import numpy as np

    arrived = np.load(real)
    make_index(method, warm_up=arrived)
    index, rows, inserted_ms, before = make_index(method), [], [], memory_mb("VmRSS")
    questions = itertools.islice(places(arrived, np.random.default_rng(SEED + 1)), len(arrived), None)
    for number, place in zip(
        range(min(most, MOST[method])), places(arrived, np.random.default_rng(SEED)), strict=False
    ):
        inserted_ms.append(timed_ms(lambda: index.add(number, place)))  # noqa: B023
        if number + 1 in MARKS:
            query_ms = np.mean([timed_ms(lambda: index.query(next(questions), 20)) for _ in range(ASKED)])
            insert_ms, growth = np.mean(inserted_ms), memory_mb("VmRSS") - before
            rows.append((method, number + 1, insert_ms, max(inserted_ms), query_ms, insert_ms + query_ms,
                         1e3 * growth / (number + 1), memory_mb("VmHWM"), index.word_count))  # fmt: skip
            inserted_ms.clear()
            print(*rows[-1], flush=True)
    return rows, None if method == "brute force" else words_row(method, index, next(questions))


def make_index(method: str, warm_up: Any = None) -> Any:
    """An empty index; ``warm_up``: places that it takes in to load every kernel."""
    import numpy as np

    from fcslam.places.index import PlaceIndex
    from fcslam.places.vocabulary import Scoring, Strategy, TreeConfig, VocabularyConfig

    class FixedIndex(PlaceIndex[int]):
        """Trained once, on the first 300 places."""

        def add(self, place: int, descriptors: Any) -> None:
            super().add(place, descriptors)
            if len(self) == 300:
                self.train([self.descriptors(number) for number in range(300)])

    fixed = VocabularyConfig(
        strategy=Strategy.REBUILD, scoring=Scoring.WORDS, train_batch=10**9, tree=TreeConfig(branching=10, depth=5)
    )
    rng = np.random.default_rng(SEED)
    index: Any = BruteForce()
    if method != "brute force":
        index = FixedIndex(fixed, rng) if method == "static" else PlaceIndex[int](VocabularyConfig(), rng)
    for number, place in enumerate([] if warm_up is None else warm_up[:320]):
        index.query(place, 1)
        index.add(number, place)
    return index


class BruteForce:
    """Counts the descriptors of the query that are near one of the place."""

    word_count = 0

    def __init__(self) -> None:
        self._places: list[Any] = []

    def add(self, _: int, descriptors: Any) -> None:
        self._places.append(descriptors)

    def query(self, descriptors: Any, top_k: int) -> list[int]:
        from fcslam.features.codes import hamming_matrix

        near = [int((hamming_matrix(descriptors, place).min(axis=1) <= 48).sum()) for place in self._places]
        return sorted(range(len(near)), key=near.__getitem__, reverse=True)[:top_k]


def words_row(method: str, index: Any, descriptors: Any) -> tuple:
    import numpy as np

    from fcslam.features.codes import code_words
    from fcslam.places.kmeans_tree import find_leaves

    codes = code_words(np.resize(descriptors, (1_000, 32)))
    tree = index.vocabulary.tree
    return method, len(index), np.median([timed_ms(lambda: find_leaves(tree, codes)) for _ in range(20)])


def timed_ms(work: Callable[[], Any]) -> float:
    """CPU time of this thread."""
    began = time.thread_time()
    work()
    return 1e3 * (time.thread_time() - began)


def memory_mb(name: str) -> float:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:")) * 1024 / 1e6


def draw(rows: list[tuple]) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 3.6), layout="constrained")
    columns = list(COSTS)
    for axes, name in zip(figure.subplots(1, 3), ("insert, ms", "query, ms", "memory a place, kB"), strict=True):
        for method in MOST:
            own = [row for row in rows if row[0] == method]
            axes.plot([row[1] for row in own], [row[columns.index(name)] for row in own], "o-", label=method)
        axes.set(xscale="log", xlabel="places", title=name)
        if name != "memory a place, kB":
            axes.set_yscale("log")
        else:
            axes.set_ylim(0.0, 30.0)
    axes.legend(fontsize=8)
    return figure


if __name__ == "__main__":
    main()
