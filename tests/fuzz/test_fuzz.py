"""Every target of the fuzzer runs, and the fuzzer finds what it looks for."""

import importlib.util
import mmap
import random
import sys
from functools import partial
from pathlib import Path

import pytest

from fcslam.config import one_line, parse_yaml
from fcslam.errors import InputError, SourceError
from fcslam.mission.localization import read_map
from fcslam.wire.packets import encode
from tests.fuzz.mutations import mutate
from tests.fuzz.targets import TARGETS, attempt
from tests.wire.examples import EXAMPLES

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def fuzz(monkeypatch):
    """The script as a module."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    spec = importlib.util.spec_from_file_location("benchmark_fuzz", BENCHMARKS / "fuzz.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)  # dataclasses look for it
    spec.loader.exec_module(module)
    yield module
    sys.modules.pop("common", None)


def found(fuzz, tmp_path, attempt):
    outcome = fuzz.Outcome("maps")
    with mmap.mmap(-1, 8) as counter:
        fuzz.fuzz(attempt, outcome, 0, 0.2, tmp_path, counter)
    return outcome


def test_the_script_knows_every_target(fuzz):
    assert set(fuzz.TARGETS) == set(TARGETS)


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS)
def test_every_target_reads_some_inputs_and_refuses_others(target, tmp_path):
    if target == "federated":
        pytest.importorskip("torch", reason="needs fcslam[federated]")
    with TARGETS[target](tmp_path) as opened:
        outcomes = (opened.attempt(random.Random(f"{target} {number}")) for number in range(150))
        first = next(outcomes)
        assert any(outcome is not first for outcome in outcomes)
        for seed in opened.seeds:
            opened.read(seed)


@pytest.mark.slow
def test_every_flip_of_one_bit_of_a_packet_is_read_or_refused(tmp_path):
    with TARGETS["packets"](tmp_path) as opened:
        for data in map(encode, EXAMPLES.values()):
            for bit in range(8 * len(data)):
                flipped = bytearray(data)
                flipped[bit // 8] ^= 1 << bit % 8
                attempt(partial(opened.read, bytes(flipped)))


def test_an_exception_is_a_finding_with_the_command_that_repeats_it(fuzz, tmp_path, monkeypatch):
    monkeypatch.setattr(fuzz, "WARM_UP", sys.maxsize)  # this process keeps its memory and its files unwatched

    def breaks(rng):
        raise KeyError("no such name")

    outcome = found(fuzz, tmp_path, breaks)
    assert len(outcome.findings) == fuzz.MOST_FINDINGS
    assert "KeyError" in outcome.findings[0]
    assert "--targets maps --seed 0 --input 0" in outcome.findings[0]


def test_the_same_seed_and_number_break_an_input_in_the_same_way(fuzz):
    data = b"resolution: 0.05\n" * 20
    first, again, other = (mutate(fuzz.generator("maps", 3, number), data, [data]) for number in (7, 7, 8))
    assert first == again != other


def test_a_long_reason_is_a_finding():
    def refuse():
        raise InputError("x" * 5000)

    with pytest.raises(AssertionError, match="5000 characters"):
        attempt(refuse)


@pytest.mark.parametrize("text", ["[" * 3000, "9" * 5000, "2020-13-45", "!!float ''", "? [1, 2]", "*a"])
def test_yaml_that_its_parser_fails_on_is_refused_in_a_line(text):
    with pytest.raises(ValueError, match=r"^not valid YAML") as refused:
        parse_yaml(text)
    assert "\n" not in str(refused.value)
    assert one_line("a\nb") == "a b"


def test_the_image_of_a_map_in_the_home_of_nobody_is_one_line(tmp_path):
    """Found by coverage."""
    (tmp_path / "map.yaml").write_text("image: ~nobody-of-this-name/map.pgm\n")
    with pytest.raises(SourceError, match="cannot be read as a map"):
        read_map(tmp_path / "map.yaml")
