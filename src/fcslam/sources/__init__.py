"""Reads recordings, and writes bags. ``open_source(path)`` reads every format as a stream of sensor records."""

from fcslam.sources.bags.options import BagOptions
from fcslam.sources.bags.writer import BAG_SUFFIXES, write_bag
from fcslam.sources.faults import Fault, FaultCount, Faults
from fcslam.sources.formats import IN_PLANE, check_copies, open_fleet, open_source, planar_note, whole_clouds
from fcslam.sources.source import Source, Survey, split

__all__ = [
    "BAG_SUFFIXES",
    "IN_PLANE",
    "BagOptions",
    "Fault",
    "FaultCount",
    "Faults",
    "Source",
    "Survey",
    "check_copies",
    "open_fleet",
    "open_source",
    "planar_note",
    "split",
    "whole_clouds",
    "write_bag",
]
