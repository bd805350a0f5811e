"""The result of a mission, in memory and as a run folder."""

from fcslam.runs.folder import CONFIG as CONFIG
from fcslam.runs.folder import LOCAL as LOCAL
from fcslam.runs.folder import METRICS as METRICS
from fcslam.runs.folder import POSE_GRAPH as POSE_GRAPH
from fcslam.runs.folder import TRAJECTORIES as TRAJECTORIES
from fcslam.runs.folder import Run as Run
from fcslam.runs.folder import check_names as check_names
from fcslam.runs.folder import open_run as open_run
from fcslam.runs.folder import prepare_output as prepare_output
from fcslam.runs.records import ClosureRow as ClosureRow
from fcslam.runs.records import Join as Join
from fcslam.runs.records import LocalizedPoses as LocalizedPoses
from fcslam.runs.records import LocalMap as LocalMap
from fcslam.runs.records import Metric as Metric
from fcslam.runs.records import RobotTrajectory as RobotTrajectory
from fcslam.runs.separations import Separation as Separation
from fcslam.runs.separations import separations as separations
from fcslam.runs.tables import metrics_json as metrics_json
from fcslam.runs.tables import read_tum as read_tum
from fcslam.runs.tables import write_tum as write_tum
from fcslam.runs.verdict import QUALITY as QUALITY
from fcslam.runs.verdict import MapVerdict as MapVerdict
from fcslam.runs.verdict import Use as Use
