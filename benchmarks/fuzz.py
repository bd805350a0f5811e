"""Broken packets, imports, recordings, requests, federated messages, settings, maps: read, or refused in words.

    python benchmarks/fuzz.py --seconds 60

A target takes valid inputs, breaks them at random, and reads them in a process of its own. A finding is any exception
but a refusal in words, an input that takes more than 20 s, more than 1 GB of memory beyond that of valid inputs, a file
written outside the target's folder, or a process that dies. Each finding is printed with the command that repeats it.
Without --seed, every run draws another one.
"""

import faulthandler
import json
import mmap
import os
import random
import resource
import secrets
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import common

TARGETS = ("packets", "imports", "recordings", "http", "federated", "configuration", "maps")
LONGEST_S = 20.0
MOST_BYTES = 10**9
GRACE_S = 120.0
"""For the start of a target: it makes its valid inputs and compiles."""
WARM_UP = 20
"""Inputs after which memory and files count."""
MOST_FINDINGS = 20
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


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each target")
    parser.add_argument("--jobs", type=int, default=2, help="targets at once")
    parser.add_argument("--targets", nargs="+", default=TARGETS, choices=TARGETS, help="all by default")
    parser.add_argument("--seed", type=int, default=secrets.randbelow(2**32), help="of the random generator")
    parser.add_argument("--input", type=int, help="repeat this input of one target, with the seed of the finding")
    parser.add_argument("--inside", type=Path, help="run one target in this folder; for this script itself")
    chosen = parser.parse_args()
    if chosen.input is not None:
        repeat(chosen.targets[0], chosen.seed, chosen.input)
        return
    if chosen.inside is not None:
        run_inside(chosen.targets[0], chosen.seed, chosen.seconds, chosen.inside)
        return
    print(f"seed {chosen.seed}", flush=True)
    report = common.Report(__file__, __doc__, chosen)
    with ThreadPoolExecutor(chosen.jobs) as pool:
        outcomes = list(
            pool.map(lambda target: outcome_of(target, chosen.seed, chosen.seconds), runnable(chosen.targets))
        )
    report.say(f"Seed {chosen.seed}, {chosen.seconds:.0f} s of each target, {chosen.jobs} at a time.")
    report.table("Targets", COLUMNS, map(row, outcomes))
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
        outcome.grew_bytes / 1e6,
    )  # fmt: skip


def outcome_of(target: str, seed: int, seconds: float) -> Outcome:
    """Run a target in a process of its own, which it may end or fill."""
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        counter = Path(folder) / "counter"
        counter.write_bytes(bytes(8))
        command = [sys.executable, __file__, "--targets", target, "--seed", str(seed), "--seconds", str(seconds)]
        try:
            ended = subprocess.run(
                [*command, "--inside", folder], capture_output=True, text=True, errors="replace", check=False,
                timeout=seconds + LONGEST_S + GRACE_S,
            )  # fmt: skip
            fate, words = f"the process ended with {ended.returncode}", ended.stderr[-3000:]
        except subprocess.TimeoutExpired as late:
            fate, words = f"the process did not end after {late.timeout:.0f} s", ""
        written = Path(folder) / "outcome.json"
        if written.exists():
            return Outcome(**json.loads(written.read_text(encoding="utf-8")))
        (number,) = struct.unpack("q", counter.read_bytes())
    return Outcome(target, number + 1, findings=[f"{fate}\n{words}\n{how_to_repeat(target, seed, number)}"])


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
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder, opened(target)(Path(folder)) as attempt:
        faulthandler.dump_traceback_later(LONGEST_S, exit=True)
        print("read" if attempt(generator(target, seed, number)) else "refused")
        faulthandler.cancel_dump_traceback_later()


def run_inside(target: str, seed: int, seconds: float, folder: Path) -> None:
    """Run a target and write what came of it into the folder; the process may die on the way."""
    outcome = Outcome(target)
    (place := folder / "work").mkdir()
    with (folder / "counter").open("r+b") as file:
        counter = mmap.mmap(file.fileno(), 8)
    with opened(target)(place) as attempt:
        fuzz(attempt, outcome, seed, seconds, folder, counter)
    (folder / "outcome.json").write_text(json.dumps(asdict(outcome)), encoding="utf-8")


def fuzz(attempt: Any, outcome: Outcome, seed: int, seconds: float, folder: Path, counter: mmap.mmap) -> None:
    outside: list[str] = []
    until, armed, early_bytes = time.monotonic() + seconds, 0.0, 0
    while (now := time.monotonic()) < until and len(outcome.findings) < MOST_FINDINGS:
        if now > armed + 1.0:  # arming starts a thread, which takes longer than reading a packet
            faulthandler.dump_traceback_later(LONGEST_S, exit=True)
            armed = now
        if outcome.inputs == WARM_UP:
            early_bytes = resident_bytes()
            watch_files(folder, outside)
            limit_memory()
        counter[:] = struct.pack("q", outcome.inputs)
        trouble = None
        try:
            outcome.read += attempt(generator(outcome.target, seed, outcome.inputs))
        except Exception as error:  # what is looked for
            trouble = f"{type(error).__name__}: {str(error)[:500]}"
        if outside:
            trouble = f"written outside: {outside.pop()}"
            outside.clear()
        outcome.slowest_s = max(outcome.slowest_s, time.monotonic() - now)
        if outcome.inputs > WARM_UP and outcome.inputs % 100 == 0:
            outcome.grew_bytes = max(outcome.grew_bytes, resident_bytes() - early_bytes)
            if outcome.grew_bytes > MOST_BYTES:
                trouble = f"{outcome.grew_bytes / 1e6:.0f} MB more than at the start"
        if trouble is not None:
            outcome.findings.append(f"{trouble}\n{how_to_repeat(outcome.target, seed, outcome.inputs)}")
        outcome.inputs += 1
    faulthandler.cancel_dump_traceback_later()


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
        if not writes or isinstance(path, int):
            return
        absolute = os.path.normpath(os.path.join(root, os.fsdecode(path)))
        # Compiled code is cached beside its source.
        if not absolute.startswith((inside, "/dev/", "/proc/")) and "__pycache__" not in absolute:
            outside.append(f"{event} {absolute}")

    sys.addaudithook(note)


if __name__ == "__main__":
    main()
