"""Live robots on a ROS network, without a ROS installation: messages in, map and pose out."""
