"""The progress display: a bar that fits 80 columns, plain lines without a terminal, nothing if quiet."""

import io
import re
import time

from rich.console import Console

from fcslam.cli.progress import ProgressDisplay

DETAILS = "290 x real time, 1234 closures, 5678 keyscans, and more than a terminal is wide"


def console(terminal=False, **options):
    return Console(file=io.StringIO(), width=80, force_terminal=terminal, **options)


def shown(console):
    return console.file.getvalue()


def wait_for_lines(console, count):
    end = time.monotonic() + 120.0
    while shown(console).count("\n") < count and time.monotonic() < end:
        time.sleep(0.01)
    return shown(console).splitlines()


def test_bar_count_and_time_fit_80_columns():
    terminal = console(terminal=True, legacy_windows=False, color_system=None)
    with ProgressDisplay(terminal) as display:
        for scans in (0, 500, 999):
            display.show("mapping", scans, 1000, DETAILS)
            time.sleep(0.01)
        line = terminal.render_lines(display._bars.get_renderable(), terminal.options)[0]
        text = "".join(segment.text for segment in line)
    assert len(text) == 80
    assert re.match(r"mapping [━╸╺ ]{16}  ?999/1000 0:00:0\d 0:00:0\d 290 x real time", text)
    assert "…" in text


def test_without_a_terminal_plain_lines_come_even_if_nothing_happens_but_seldom():
    pipe = console()
    began = time.monotonic()
    with ProgressDisplay(pipe, "output: runs/now", interval_s=0.02) as display:
        display.show("mapping", 12, 40, "3 closures")
        first, *lines = wait_for_lines(pipe, 4)
        assert time.monotonic() - began > 2 * 12 * 0.02
    assert first == "output: runs/now"
    assert {re.sub(r"\d+:[\d:]+|-:--:--", "T", line) for line in lines} == {"mapping 12/40, T, T left, 3 closures"}


def test_the_time_left_is_not_guessed_from_the_first_items():
    pipe = console()
    with ProgressDisplay(pipe, interval_s=0.02) as display:
        for scans in range(5):
            display.show("mapping", scans, 100)
            time.sleep(0.01)
        (line, *_) = wait_for_lines(pipe, 1)
    assert "left" not in line


def test_a_stage_of_unknown_length_shows_its_count_and_the_time_it_took():
    pipe = console()
    with ProgressDisplay(pipe, interval_s=0.02) as display:
        display.start("reading", 1)()
        display.start("sorting")
        advance = display.start("describing")
        advance()
        advance()
        lines = wait_for_lines(pipe, 1)
    assert re.fullmatch(r"describing 2/\?, 0:00:\d\d", lines[-1])


def test_a_stage_that_starts_again_counts_again():
    pipe = console()
    with ProgressDisplay(pipe, interval_s=0.02) as display:
        display.show("local training", 6, 6, "one")
        display.show("local training", 1, 6, "two")
        lines = wait_for_lines(pipe, 1)
    assert lines[0].startswith("local training 1/6")
    assert lines[0].endswith("two")


def test_quiet_is_silent_on_a_terminal_and_elsewhere():
    for terminal in (False, True):
        silent = console(terminal=terminal, quiet=True)
        with ProgressDisplay(silent, "output: runs/now", interval_s=0.01) as display:
            display.show("mapping", 12, 40)
            time.sleep(0.05)
        assert shown(silent) == ""
