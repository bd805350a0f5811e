"""Broken packets, imports, recordings, requests, federated messages, settings, maps: read, or refused in words.

    python benchmarks/fuzz.py --seconds 60

A target takes valid inputs, breaks them at random, and reads them in a process of its own. A finding is any exception
but a refusal in words, an input that takes more than 20 s, more than 1 GB of memory beyond that of valid inputs, a file
written outside the target's folder, or a process that dies. Each finding is printed with the command that repeats it.
Without --seed, every run draws another one.

    python benchmarks/fuzz.py --coverage --seconds 600

With --coverage, atheris makes the inputs: whole files and packets, from the valid ones on. It keeps each input that
takes a new branch in the code of fcslam. Rows of a mission get valid seals before it is read. This needs
`pip install atheris`.
"""

import faulthandler
import hashlib
import json
import mmap
import os
import random
import re
import resource
import secrets
import struct
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import common

TARGETS = ("packets", "imports", "logs", "bags", "http", "federated", "configuration", "maps")
BY_COVERAGE = ("packets", "imports", "logs", "bags", "maps")
"""Those that read one file or message."""
LONGEST_S = 20.0
MOST_BYTES = 10**9
GRACE_S = 120.0
"""For the start of a target: it makes its valid inputs and compiles."""
WARM_UP = 20
"""Inputs after which memory and files count."""
MOST_FINDINGS = 20
SITES = re.compile(r"cov: (\d+) ft: \d+ corp: (\d+)")
"""What libFuzzer says of branches and kept inputs."""
COVERED = {"branches, valid inputs": ",", "branches": ",", "kept inputs": ","}
COLUMNS = {
    "target": "", "inputs": ",", "read": ",", "refused": ",", "findings": ",", "slowest, ms": ".0f",
    "memory grew, MB": ".0f",
}  # fmt: skip
WRITES = {"os.mkdir": 0, "os.remove": 0, "os.rmdir": 0, "os.chmod": 0, "os.rename": 1, "os.link": 1, "os.symlink": 1}
"""Events of Python that change what is on disk, and which of their arguments is the changed path. The last argument is
the folder that the path is relative to, or -1."""


@dataclass
class Outcome:
    """What came of the inputs of a target."""

    target: str
    inputs: int = 0
    read: int = 0
    slowest_s: float = 0.0
    grew_bytes: int = 0
    findings: list[str] = field(default_factory=list)
    covered: tuple[int, ...] = ()
    """Branches of the valid inputs and of all, and kept inputs."""


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each target")
    parser.add_argument("--jobs", type=int, default=2, help="targets at once")
    parser.add_argument("--targets", nargs="+", default=TARGETS, choices=TARGETS, help="all by default")
    parser.add_argument("--seed", type=int, default=secrets.randbelow(2**32), help="of the random generator")
    parser.add_argument("--input", type=int, help="repeat this input of one target, with the seed of the finding")
    parser.add_argument("--coverage", action="store_true", help="make inputs by coverage")
    parser.add_argument("--file", type=Path, help="repeat this input of one target, which --coverage found")
    parser.add_argument("--inside", type=Path, help="run one target in this folder; for this script itself")
    chosen = parser.parse_args()
    if chosen.input is not None:
        repeat(chosen.targets[0], chosen.seed, chosen.input)
        return
    if chosen.file is not None:
        repeat_file(chosen.targets[0], chosen.file)
        return
    if chosen.inside is not None:
        run_inside(chosen.targets[0], chosen.seed, chosen.seconds, chosen.inside, chosen.coverage)
        return
    print(f"seed {chosen.seed}", flush=True)
    targets = runnable(chosen.targets)
    if chosen.coverage:
        targets = [target for target in targets if target in BY_COVERAGE]
    report = common.Report("fuzz_coverage" if chosen.coverage else __file__, __doc__, chosen)
    with ThreadPoolExecutor(chosen.jobs) as pool:
        outcomes = list(
            pool.map(lambda target: outcome_of(target, chosen.seed, chosen.seconds, chosen.coverage), targets)
        )
    report.say(f"Seed {chosen.seed}, {chosen.seconds:.0f} s of each target, {chosen.jobs} at a time.")
    columns = {**COLUMNS, **(COVERED if chosen.coverage else {})}
    report.table("Targets", columns, map(row, outcomes))
    report.write()
    findings = [f"{each.target}: {finding}" for each in outcomes for finding in each.findings]
    if findings:
        sys.exit("\n".join(findings))
    print(f"{sum(each.inputs for each in outcomes):,} inputs, 0 findings")


def runnable(targets: Sequence[str]) -> list[str]:
    """The targets whose packages are installed."""
    has_learning = find_spec("torch") is not None and find_spec("flwr") is not None
    if not has_learning and "federated" in targets:
        print("federated: left out, needs fcslam[federated]")
    return [target for target in targets if target != "federated" or has_learning]


def row(outcome: Outcome) -> tuple:
    refused = max(0, outcome.inputs - outcome.read - len(outcome.findings))
    return (
        outcome.target, outcome.inputs, outcome.read, refused, len(outcome.findings), 1e3 * outcome.slowest_s,
        outcome.grew_bytes / 1e6, *outcome.covered,
    )  # fmt: skip


def outcome_of(target: str, seed: int, seconds: float, coverage: bool) -> Outcome:
    """Run a target in a process of its own, which it may end or fill."""
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        counter = Path(folder) / "counter"
        counter.write_bytes(bytes(8))
        command = [sys.executable, __file__, "--targets", target, "--seed", str(seed), "--seconds", str(seconds)]
        command += ["--inside", folder, *(["--coverage"] if coverage else [])]
        try:
            ended = subprocess.run(
                command, capture_output=True, text=True, errors="replace", check=False,
                timeout=seconds + LONGEST_S + GRACE_S,
            )  # fmt: skip
            fate, words = f"the process ended with {ended.returncode}", ended.stdout[-2000:] + ended.stderr[-2000:]
            sites = SITES.findall(ended.stderr)
            is_whole = not coverage or (ended.returncode == 0 and bool(sites))
        except subprocess.TimeoutExpired as late:
            fate, words, sites, is_whole = f"the process did not end after {late.timeout:.0f} s", "", [], False
        written = Path(folder) / "outcome.json"
        if is_whole and written.exists():
            outcome = Outcome(**json.loads(written.read_text(encoding="utf-8")))
            outcome.covered = (int(sites[0][0]), *map(int, sites[-1])) if coverage else ()
            return outcome
        (number,) = struct.unpack("q", counter.read_bytes())
    covered = (0, 0, 0) if coverage else ()
    return Outcome(
        target, number + 1, covered=covered, findings=[f"{fate}\n{words}\n{how_to_repeat(target, seed, number)}"]
    )


def how_to_repeat(target: str, seed: int, number: int) -> str:
    return f"repeat with: python benchmarks/fuzz.py --targets {target} --seed {seed} --input {number}"


def opened(target: str) -> Any:
    """The target: a function of a folder, which gives a context."""
    if str(common.REPOSITORY) not in sys.path:
        sys.path.insert(0, str(common.REPOSITORY))
    from tests.fuzz.targets import TARGETS as ALL

    return ALL[target]


def generator(target: str, seed: int, number: int) -> random.Random:
    """Each input has its own, so that one can be repeated alone."""
    return random.Random(f"{seed} {target} {number}")


def repeat(target: str, seed: int, number: int) -> None:
    """Run one input alone and let its exception through."""
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder, opened(target)(Path(folder)) as made:
        faulthandler.dump_traceback_later(LONGEST_S, exit=True)
        print("read" if made.attempt(generator(target, seed, number)) else "refused")
        faulthandler.cancel_dump_traceback_later()


def repeat_file(target: str, file: Path) -> None:
    """Read one input alone and let its exception through."""
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder, opened(target)(Path(folder)) as made:
        faulthandler.dump_traceback_later(LONGEST_S, exit=True)
        made.read(file.read_bytes())
        faulthandler.cancel_dump_traceback_later()


def run_inside(target: str, seed: int, seconds: float, folder: Path, coverage: bool) -> None:
    """Run a target and write what came of it into the folder; the process may die on the way."""
    outcome = Outcome(target)
    (place := folder / "work").mkdir()
    with (folder / "counter").open("r+b") as file:
        counter = mmap.mmap(file.fileno(), 8)
    if coverage:
        fuzz_by_coverage(outcome, seed, seconds, folder, counter)
    with opened(target)(place) as made:
        fuzz(made.attempt, outcome, seed, seconds, folder, counter)
    (folder / "outcome.json").write_text(json.dumps(asdict(outcome)), encoding="utf-8")


def fuzz(attempt: Any, outcome: Outcome, seed: int, seconds: float, folder: Path, counter: mmap.mmap) -> None:
    judge = Judge(outcome, folder, counter)
    until = time.monotonic() + seconds
    while time.monotonic() < until and len(outcome.findings) < MOST_FINDINGS:
        judge.judge(
            lambda: attempt(generator(outcome.target, seed, outcome.inputs)),
            lambda: how_to_repeat(outcome.target, seed, outcome.inputs),
        )
    faulthandler.cancel_dump_traceback_later()


def fuzz_by_coverage(outcome: Outcome, seed: int, seconds: float, folder: Path, counter: mmap.mmap) -> None:
    """Let atheris make the inputs; it ends the process."""
    import atheris

    package = Path(common.fcslam.__file__).parent
    compiled = [
        ".".join(path.relative_to(package.parent).with_suffix("").parts)
        for path in package.rglob("*.py")
        if "njit" in path.read_text(encoding="utf-8")
    ]
    (corpus := folder / "corpus").mkdir()
    kept: set[str] = set()
    written_s = 0.0
    with atheris.instrument_imports(include=["fcslam"], exclude=compiled):
        made = opened(outcome.target)(folder / "work").__enter__()
        from tests.fuzz.targets import attempt

        for number, seed_input in enumerate(made.seeds):
            (corpus / str(number)).write_bytes(seed_input)
            made.read(seed_input)  # compiles
        judge = Judge(outcome, folder, counter, GRACE_S)  # a new branch may have to be compiled

        def one(data: bytes) -> None:
            nonlocal written_s

            def saved() -> str:
                path = Path(tempfile.gettempdir()) / f"fuzz-{outcome.target}-{hashlib.sha256(data).hexdigest()[:16]}"
                path.write_bytes(data)
                return f"repeat with: python benchmarks/fuzz.py --targets {outcome.target} --file {path}"

            judge.judge(lambda: attempt(lambda: made.read(data)), saved, kept)
            if time.monotonic() > written_s + 1.0:
                (folder / "outcome.json").write_text(json.dumps(asdict(outcome)), encoding="utf-8")
                written_s = time.monotonic()

        limits = (f"-max_total_time={seconds:.0f}", f"-seed={seed % 2**31 + 1}", "-max_len=200000", "-rss_limit_mb=0")
        atheris.Setup([sys.argv[0], *limits, f"-timeout={GRACE_S:.0f}", "-detect_leaks=0", str(corpus)], one)
        atheris.Fuzz()


class Judge:
    """Reads inputs and notes what must not happen."""

    def __init__(self, outcome: Outcome, folder: Path, counter: mmap.mmap, patience_s: float = LONGEST_S) -> None:
        self._patience_s = patience_s
        self._outcome, self._folder, self._counter = outcome, folder, counter
        self._outside: list[str] = []
        self._armed, self._early_bytes = 0.0, 0

    def judge(self, attempt: Callable[[], bool], how: Callable[[], str], known: set[str] | None = None) -> None:
        """Read one input; ``known`` holds the places of exceptions that count once."""
        outcome, now = self._outcome, time.monotonic()
        if now > self._armed + 1.0:  # arming starts a thread, which takes longer than reading a packet
            faulthandler.dump_traceback_later(self._patience_s, exit=True)
            self._armed = now
        if outcome.inputs == WARM_UP:
            self._early_bytes = resident_bytes()
            watch_files(self._folder, self._outside)
            limit_memory()
        self._counter[:] = struct.pack("q", outcome.inputs)
        trouble = None
        try:
            outcome.read += attempt()
        except Exception as error:  # what is looked for
            trouble = f"{type(error).__name__}: {str(error)[:500]}"
            if known is not None:
                last = traceback.extract_tb(error.__traceback__)[-1]
                place = f"{type(error).__name__} {last.filename}:{last.lineno}"
                trouble = None if place in known else f"{trouble} in {last.filename}:{last.lineno}"
                known.add(place)
        if self._outside:
            trouble = f"written outside: {self._outside.pop()}"
            self._outside.clear()
        outcome.slowest_s = max(outcome.slowest_s, time.monotonic() - now)
        if outcome.inputs > WARM_UP and outcome.inputs % 100 == 0:
            outcome.grew_bytes = max(outcome.grew_bytes, resident_bytes() - self._early_bytes)
            if outcome.grew_bytes > MOST_BYTES:
                trouble = f"{outcome.grew_bytes / 1e6:.0f} MB more than at the start"
        if trouble is not None:
            outcome.findings.append(f"{trouble}\n{how()}")
            self._outside.clear()  # where a finding is kept
        outcome.inputs += 1


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * resource.getpagesize()


def limit_memory() -> None:
    """More than the limit at once is a MemoryError, whether it is used or not."""
    mapped = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (mapped + 2 * MOST_BYTES, resource.RLIM_INFINITY))


def watch_files(folder: Path, outside: list[str]) -> None:
    """Note every file that this process writes outside the folder. Python cannot take this back."""
    inside, root = os.path.realpath(folder), os.getcwd()

    def note(event: str, arguments: tuple) -> None:
        if event == "open":
            path, mode, flags = arguments
            writes = bool((flags or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)) or bool(set(mode or "") & set("wax+"))
        elif event in WRITES:
            path, writes = arguments[WRITES[event]], arguments[-1] == -1  # else tempfile, which clears its own folder
        else:
            return
        # A file that is opened by the name of its folder has no name, and ends with the process.
        if not writes or isinstance(path, int) or (event == "open" and os.path.isdir(path)):
            return
        absolute = os.path.normpath(os.path.join(root, os.fsdecode(path)))
        # Compiled code is cached beside its source.
        if not absolute.startswith((inside, "/dev/", "/proc/")) and "__pycache__" not in absolute:
            outside.append(f"{event} {absolute}")

    sys.addaudithook(note)


if __name__ == "__main__":
    main()
