"""Runs `fcslam robot` as a process beside the nodes of a robot.

ros2 launch ros/fcslam_ros/launch/fcslam.launch.py namespace:=/robot1 use_sim_time:=true
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration

PARAMETERS = Path(__file__).parents[1] / "config" / "fcslam.yaml"
ARGUMENTS = {
    "namespace": ("/", "namespace of the robot's topics"),
    "params_file": (str(PARAMETERS), "parameters, a YAML file"),
    "use_sim_time": ("false", "true where /clock is the time"),
    "server": ("", "address of `fcslam serve`; empty: the robot maps alone"),
    "state": ("", "folder of the packets that the server has not confirmed"),
    "output": ("", "run folder to write at the end; empty: runs/<time>"),
}


def command(context):
    """The command of these arguments; empty ones are left out."""
    value = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    words = ["fcslam", "robot", f"ros2:{value['namespace']}", "--ros-parameters", value["params_file"]]
    words += ["--use-sim-time"] if value["use_sim_time"].lower() == "true" else []
    for name in ("server", "state", "output"):
        words += [f"--{name}", value[name]] if value[name] else []
    return [ExecuteProcess(cmd=words, output="screen", sigterm_timeout="60")]


def generate_launch_description():
    """What `ros2 launch` runs."""
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=command)])
