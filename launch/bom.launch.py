"""Starts the node. `ros2 launch bayesian_object_models bom.launch.py --show-args` lists the arguments."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue
from launch_ros.substitutions import FindPackageShare

PACKAGE = "bayesian_object_models"

ARGUMENTS = {
    "name": ("bom", "Name of the node"),
    "namespace": ("", "Namespace of the node and of its relative topics"),
    "points": ("parts/points", "Segmented clouds, sensor_msgs/PointCloud2"),
    "wrench": ("wrench", "Wrenches, geometry_msgs/WrenchStamped"),
    "fixed_frame": ("world", "The frame, at rest, in which everything is estimated"),
    "root_label": ("-1", "The part that is fixed to the world; -1: found out"),
    "reaction": ("false", "Whether the sensor reports what the object does to the tool"),
    "use_sim_time": ("false", "Whether /clock is the time"),
    "autostart": ("true", "Whether the node configures and activates itself; false: a lifecycle manager does"),
    "publish_tf": ("false", "Whether the parts' frames are sent on /tf"),
    "params_file": (
        PathJoinSubstitution([FindPackageShare(PACKAGE), "config", "node.yaml"]),
        "Parameters, YAML; the arguments above go before it",
    ),
    "log_level": ("info", "debug, info, warn or error"),
    "rviz": ("false", "Whether RViz is started with the view of the object"),
}


def generate_launch_description():
    argument = {name: LaunchConfiguration(name) for name in ARGUMENTS}

    def typed(name, kind):
        return ParameterValue(argument[name], value_type=kind)

    node = Node(
        package=PACKAGE,
        executable="bom",
        arguments=["node"],
        name=argument["name"],
        namespace=argument["namespace"],
        output="screen",
        emulate_tty=True,
        remappings=[("parts/points", argument["points"]), ("wrench", argument["wrench"])],
        parameters=[
            ParameterFile(argument["params_file"], allow_substs=True),
            {
                "input.fixed_frame": typed("fixed_frame", str),
                "input.wrenches.reactions": PythonExpression(["[", "'", argument["reaction"], "' == 'true']"]),
                "root_label": typed("root_label", int),
                "use_sim_time": typed("use_sim_time", bool),
                "autostart": typed("autostart", bool),
                "publish_tf": typed("publish_tf", bool),
            },
        ],
        ros_arguments=["--log-level", argument["log_level"]],
    )
    view = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", PathJoinSubstitution([FindPackageShare(PACKAGE), "rviz", "bom.rviz"])],
        condition=IfCondition(argument["rviz"]),
    )
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, node, view])
