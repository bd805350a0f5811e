"""`fcslam show`: the page of `fcslam serve` on a finished run, or as one file."""

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from fcslam.cli.listening import listen
from fcslam.cli.options import Force
from fcslam.cli.output import ELSEWHERE
from fcslam.errors import InputError, writing

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
    import asyncio  # the other commands start without a server
    import webbrowser

    from fcslam.page.report import ShownRun, report_html
    from fcslam.storage.files import write_file

    if html is not None and os.path.exists(html) and not (force and html.is_file()):
        raise InputError(f"{html}: exists; name a new file, or give --force to replace it")
    _check(run)
    with ShownRun(run) as shown:
        if html is not None:
            content = asyncio.run(report_html(shown)).encode()
            with writing(html, ELSEWHERE):
                write_file(html, content)
            typer.echo(f"report of {run}: {html} ({len(content) / 1e6:.1f} MB)")
            return
        from fcslam.page.routes import run_page, serve_page

        with listen(HOST, port) as listening:
            address = f"http://{HOST}:{listening.getsockname()[1]}/"
            typer.echo(f"fcslam shows {run} at {address}\nCtrl-C ends it")
            has_display = sys.platform == "darwin" or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
            if open_browser or (open_browser is None and has_display):
                webbrowser.open(address)
            serve_page(run_page(shown), listening)


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
