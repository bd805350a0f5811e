"""Reads recordings, and writes bags. ``open_source(path)`` reads every format as a stream of sensor records."""

from fcslam.sources.bags.options import BagOptions as BagOptions
from fcslam.sources.bags.writer import write_bag as write_bag
from fcslam.sources.faults import Fault as Fault
from fcslam.sources.faults import FaultCount as FaultCount
from fcslam.sources.faults import Faults as Faults
from fcslam.sources.formats import IN_PLANE as IN_PLANE
from fcslam.sources.formats import is_whole as is_whole
from fcslam.sources.formats import open_fleet as open_fleet
from fcslam.sources.formats import open_source as open_source
from fcslam.sources.formats import whole_clouds as whole_clouds
from fcslam.sources.source import Source as Source
from fcslam.sources.source import Survey as Survey
from fcslam.sources.source import split as split
