"""`fcslam tools extract`: keypoints and descriptors of images."""

from pathlib import Path
from typing import Annotated

import typer

from fcslam.cli.options import output_option
from fcslam.cli.output import FEATURES, new_folder, notices, print_line
from fcslam.errors import FeatureError
from fcslam.features.detector_kinds import DetectorKind


def extract(
    images: Annotated[Path, typer.Argument(help="An image, or a folder of images, searched with its subfolders.")],
    *,
    output: Annotated[
        Path | None, output_option("Folder for the features, one .npz file for each image.", FEATURES)
    ] = None,
    detector: Annotated[
        str,
        typer.Option(metavar="orb|onnx|FILE", help="orb, onnx (the bundled network), or the .onnx file of a network."),
    ] = "onnx",
    keypoints: Annotated[
        int, typer.Option(min=1, max=2000, help="Number of keypoints to keep of each image, strongest first.")
    ] = 1000,
) -> None:
    """Find keypoints in images and describe each with 256 bits."""
    from fcslam.cli.progress import ProgressDisplay
    from fcslam.features.classical import make_detector
    from fcslam.features.detector import OnnxConfig
    from fcslam.features.files import extract_all, find_files

    named = detector in list(DetectorKind)
    kind = DetectorKind(detector) if named else DetectorKind.ONNX
    onnx = OnnxConfig(weights=None if named else Path(detector), most_features=keypoints, scales=(1.0, 0.71, 0.5))
    finder = make_detector(kind, onnx)
    files = [path for path in find_files(images) if path.suffix != ".npz"]  # an earlier output may be among them
    root = images.parent if images.is_file() else images
    output = output or new_folder(FEATURES)
    console, done, empty = notices(), 0, 0
    longest_side_px = 2048  # of larger images, which are shrunk
    outcomes = extract_all(files, root, output, finder, longest_side_px)
    with ProgressDisplay(console) as display:
        extracted_one = display.start("extracting", len(files))
        for _, found in outcomes:
            extracted_one()
            if isinstance(found, str):
                print_line(console, f"skipped: {found}")
                continue
            done, empty = done + 1, empty + (not found)
    if not done:
        raise FeatureError(f"{images}: no usable image there, {len(files)} files skipped; give JPEG, PNG, PPM or TIFF")
    without = f", {empty} of them without a keypoint" if empty else ""
    skipped = f", {len(files) - done} files skipped" if done < len(files) else ""
    typer.echo(f"{finder.version}: features of {done} images{without}{skipped}: {output}")
