"""`fcslam extract`: keypoints and descriptors of images."""

from pathlib import Path
from typing import Annotated

import typer

from fcslam.features.detector_kinds import DetectorKind


def extract(
    images: Annotated[Path, typer.Argument(help="An image, or a folder of images; folders below it count.")],
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the features, one .npz an image.")],
    detector: Annotated[
        DetectorKind | None,
        typer.Option(help="If not said: onnx where weights are given or come with fcslam, else orb."),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(help="Network weights (.onnx) of detector onnx, if not those that come with fcslam."),
    ] = None,
    keypoints: Annotated[
        int, typer.Option(min=1, max=2000, help="Keypoints kept of an image, strongest first.")
    ] = 1000,
    nms: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=64.0,
            help="Side in pixels of boxes around keypoints that may hardly overlap; 0: all. If not said: 4, of orb 0.",
        ),
    ] = None,
    longest_side: Annotated[
        int, typer.Option(min=16, max=16384, help="Larger images are shrunk to so many pixels for the detector.")
    ] = 2048,
    threads: Annotated[int, typer.Option(min=1, max=64, help="Threads of the network.")] = 1,
) -> None:
    """Find keypoints in images and describe each by 256 bits."""
    from rich.console import Console
    from rich.progress import track

    from fcslam.errors import FeatureError
    from fcslam.features.classical import OrbConfig
    from fcslam.features.detector import BUNDLED_NETWORK, OnnxConfig
    from fcslam.features.extraction import extract_all, find_files
    from fcslam.features.factory import make_detector

    is_network = weights is not None or BUNDLED_NETWORK.is_file() if detector is None else detector is DetectorKind.ONNX
    kind = DetectorKind.ONNX if is_network else DetectorKind.ORB
    if weights is not None and not is_network:
        raise FeatureError(f"{weights}: detector orb has no weights; leave --weights out, or --detector")
    onnx = OnnxConfig(weights=weights, most_features=keypoints, nms_px=4.0 if nms is None else nms, threads=threads)
    finder = make_detector(kind, OrbConfig(most_features=keypoints), onnx)
    files = [path for path in find_files(images) if path.suffix != ".npz"]  # an earlier output may lie among them
    root = images.parent if images.is_file() else images
    console, done, empty = Console(stderr=True), 0, 0
    # a network thins out its keypoints itself, before it keeps the strongest
    outcomes = extract_all(files, root, output, finder, longest_side, 0.0 if is_network else nms or 0.0)
    for outcome in track(outcomes, "extracting", len(files), console=console, transient=True):
        if outcome.skipped:
            console.print(f"skipped: {outcome.skipped}", highlight=False, markup=False, soft_wrap=True)
            continue
        done, empty = done + 1, empty + (not outcome.keypoints)
    if not done:
        raise FeatureError(f"{images}: no usable image there, {len(files)} files skipped; give JPEG, PNG, PPM or TIFF")
    without = f", {empty} of them without a keypoint" if empty else ""
    skipped = f", {len(files) - done} files skipped" if done < len(files) else ""
    line = f"{finder.version}: features of {done} images{without}{skipped}: {output}"
    Console().print(line, highlight=False, markup=False, soft_wrap=True)
