"""ROS bags: ROS 1 ``.bag``, ROS 2 ``.mcap`` and ``.db3``, and the folders that ``ros2 bag record`` makes."""
