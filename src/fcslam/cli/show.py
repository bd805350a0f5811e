"""`fcslam show`: the page of `fcslam serve` on a finished run, or as one file."""

import os
import signal
import sys
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from socket import socket
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.listening import listen
from fcslam.cli.options import Force
from fcslam.errors import InputError

if TYPE_CHECKING:
    from fcslam.page.live_map import LiveMap

LARGEST_BYTES = 2 * 2**30
"""Largest total size of the files of a run folder: the page's server holds most of them in memory."""
HOST = "127.0.0.1"


def show(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    *,
    html: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the page as one file, and serve nothing.")
    ] = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of the page on this machine; 0 chooses a free one.")
    ] = 0,
    open_browser: Annotated[
        bool | None,
        typer.Option(
            "--open/--no-open", help="Open the page in a browser.", show_default="if this machine has a display"
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Show a finished run in the browser, read-only; Ctrl-C ends it."""
    from fcslam.page.report import report_html
    from fcslam.page.shown_run import ShownRun
    from fcslam.storage.files import write_file

    if html is not None and html.exists() and not (force and html.is_file()):
        raise InputError(f"{html}: exists; name a new file, or give --force to replace it")
    _check(run)
    with ShownRun(run, run.resolve().name) as shown:
        if html is not None:
            content = report_html(shown).encode()
            try:
                write_file(html, content)
            except OSError as error:
                raise InputError(f"{html}: cannot be written ({error})") from error
            typer.echo(f"report of {run}: {html} ({len(content) / 1e6:.1f} MB)")
            return
        from fcslam.page.viewer import ReadOnly, run_viewer, viewer_app

        with listen(HOST, port) as listening:
            _announce(f"fcslam shows {run}", listening, open_browser)
            typer.echo("Ctrl-C ends it")
            run_viewer(viewer_app(ReadOnly(shown)), listening)


def _check(run: Path) -> None:
    """Refuse what is not a run, a damaged run, and one that is too large."""
    from fcslam.runs import open_run
    from fcslam.runs.folder import is_run_folder

    size = sum(path.stat().st_size for path in run.rglob("*") if path.is_file()) if is_run_folder(run) else 0
    if size > LARGEST_BYTES:
        raise InputError(
            f"{run}: the files have {size / 2**30:.1f} GiB; fcslam show reads at most {LARGEST_BYTES / 2**30:.0f} GiB"
        )
    _ = open_run(run).maps


@contextmanager
def live_page(run: Path) -> "Iterator[LiveMap]":
    """Serve the page of a run while it is mapped, and in the end until Ctrl-C if there is a terminal for that."""
    from fcslam.page import live_map

    with listen(HOST, 0) as listening, live_map.live_page(listening, run.name) as live:
        _announce(f"fcslam shows the map of {run} while it grows", listening, None)
        yield live
        if sys.stdin.isatty():
            typer.echo("The page shows the finished run; Ctrl-C ends it")
            with suppress(KeyboardInterrupt):
                signal.pause()


def _announce(what: str, listening: socket, open_browser: bool | None) -> None:
    address = f"http://{HOST}:{listening.getsockname()[1]}/"
    typer.echo(f"{what} at {address}")
    if open_browser is None:
        has_display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        open_browser = sys.platform == "darwin" or bool(has_display)
    if open_browser:
        webbrowser.open(address)
